// The birds in 3D on their ledge. The world has z up; lengths are metres or body lengths.
// @ts-check
import * as THREE from "three";
import { OrbitControls } from "orbit-controls";

/** @typedef {import("viewer/data").Packed} Packed */
/** @typedef {import("viewer/data").ResultFacts} ResultFacts */

// a camera of three.js looks along −z with y up, the camera of the film along z with y down
const TO_THREE = new THREE.Matrix4().makeScale(1, -1, -1);

/** The 3D view of one result. */
export class LedgeView {
  /** @param {HTMLElement} parent @param {ResultFacts} facts @param {(track: number, more: boolean) => void} select */
  constructor(parent, facts, select) {
    this.parent = parent;
    this.facts = facts;
    this.select = select;
    this.message = document.createElement("p");
    this.message.className = "message";
    parent.append(this.message);
    /** @type {THREE.SkinnedMesh[]} */
    this.birds = [];
    this.mode = "follow";
    this.ready = false;
    this.scene = new THREE.Scene();
    this.rock = new THREE.MeshLambertMaterial({ side: THREE.DoubleSide });
    this.orbit = new THREE.PerspectiveCamera(40, 1, 0.01, 1000);
    this.film = new THREE.PerspectiveCamera(40, 1, 0.01, 1000);
    /** @type {THREE.WebGLRenderer | null} */
    this.renderer = null;
    /** The bird that the view follows. */
    this.followed = -1;
    this.shapeOf = new Map();
    this.showAll = () => {};
    /** The keypoints of the model. @type {THREE.Mesh<THREE.SphereGeometry, THREE.MeshBasicMaterial>[] | null} */
    this.balls = null;
  }

  /** Builds the scene. @param {Packed} rig */
  open(rig) {
    this.rig = rig;
    try {
      this.renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
    } catch {
      this.message.textContent = "This browser has no WebGL, so the birds are not shown in 3D.";
      return;
    }
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.parent.prepend(this.renderer.domElement);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8d8577, 2.4));
    const sun = new THREE.DirectionalLight(0xffffff, 1.5);
    sun.position.set(1, -2, 4);
    this.scene.add(sun);
    this.openCameras();
    if (rig.facts.keypoints) this.addKeypoints(rig.facts.keypoints);
    else if (rig.facts.level) this.addLedge();
    this.facts.tracks.forEach((track) => this.addBird(track.colour));
    this.watchClicks(this.renderer.domElement);
    this.message.textContent = rig.facts.notes.join("; ");
    this.ready = true;
  }

  openCameras() {
    const { low, high, length, camera, level } = this.rig?.facts;
    const middle = new THREE.Vector3(...low).add(new THREE.Vector3(...high)).multiplyScalar(0.5);
    const [a, b, c] = camera.R_world_cam, [x, y, z] = camera.place;
    const R = new THREE.Matrix4().set(a[0], a[1], a[2], x, b[0], b[1], b[2], y, c[0], c[1], c[2], z, 0, 0, 0, 1);
    this.film.matrixAutoUpdate = false;
    this.film.matrix.copy(R.multiply(TO_THREE));
    this.film.updateMatrixWorld(true);
    this.film.fov = camera.field_deg;
    // the axis up has to be set before the controls are made
    this.orbit.up.set(0, level ? 0 : -1, level ? 1 : 0);
    const eye = new THREE.Vector3(x, y, z), size = Math.max(new THREE.Vector3(...high).distanceTo(new THREE.Vector3(...low)), 3 * length);
    this.orbit.near = 0.02 * length;
    this.orbit.far = 200 * size;
    this.film.near = this.orbit.near;
    this.film.far = this.orbit.far + eye.distanceTo(middle);
    const controls = (this.controls = new OrbitControls(this.orbit, this.renderer?.domElement));
    this.showAll = () => {
      const towards = eye.clone().sub(middle);
      if (level) towards.z = Math.max(towards.z, 0.35 * Math.hypot(towards.x, towards.y));
      this.orbit.position.copy(middle).addScaledVector(towards.normalize(), 1.2 * size + length);
      controls.target.copy(middle);
      controls.update();
    };
    this.showAll();
    controls.addEventListener("change", () => this.render());
  }

  /** Shows where the keypoints of the model are. @param {[number, number, number][]} places */
  addKeypoints(places) {
    const ball = new THREE.SphereGeometry(0.016 * this.rig?.facts.length);
    this.balls = places.map((place) => {
      const made = new THREE.Mesh(ball, new THREE.MeshBasicMaterial({ depthTest: false }));
      made.position.set(...place);
      made.renderOrder = 1;
      this.scene.add(made);
      return made;
    });
  }

  /** Shows the model in its rest pose, with one keypoint in red. @param {number} marked */
  poseModel(marked) {
    if (!this.ready || !this.rig) return;
    const J = this.rig.facts.parents.length, turns = Array.from({ length: 4 * J }, (_, i) => (i % 4 === 3 ? 1 : 0));
    const rest = { facts: { turn_step: 1 }, shapes: {}, arrays: { turns, place: [0, 0, 0], size: [1] } };
    this.birds.forEach((bird, n) => { bird.visible = n === 0; });
    this.poseBird(this.birds[0], 0, rest, 0);
    this.balls?.forEach((ball, k) => {
      ball.material.color.set(k === marked ? 0xff2020 : 0xffffff);
      ball.scale.setScalar(k === marked ? 2 : 1);
    });
    this.followBird(new Set([this.facts.tracks[0].id]));
  }

  addLedge() {
    const { low, high, length } = this.rig?.facts;
    const margin = 1.5 * length, cells = 12;
    const side = Math.max(high[0] - low[0], high[1] - low[1]) + 2 * margin;
    const grid = new THREE.GridHelper(side, Math.min(Math.max(Math.round(side / length), 2), 10 * cells), 0x6b6357, 0xa39b8c);
    grid.rotation.x = Math.PI / 2;
    grid.position.set((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, 0);
    const plane = new THREE.Mesh(new THREE.PlaneGeometry(side, side), this.rock);
    plane.position.set(grid.position.x, grid.position.y, -0.01 * length);
    this.scene.add(grid, plane);
  }

  /** @param {string} colour */
  addBird(colour) {
    const { arrays, shapes, facts } = /** @type {Packed} */ (this.rig), J = facts.parents.length;
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(arrays.vertices.slice(), 3));
    geometry.setAttribute("skinIndex", new THREE.BufferAttribute(arrays.skin_joints, 4));
    geometry.setAttribute("skinWeight", new THREE.BufferAttribute(arrays.skin_weights, 4));
    geometry.setAttribute("color", new THREE.BufferAttribute(tinted(arrays.colours, colour), 3));
    geometry.setIndex(new THREE.BufferAttribute(arrays.faces, 1));
    geometry.computeVertexNormals();
    const bones = facts.parents.map(() => new THREE.Bone()), inverses = [];
    for (let j = 0; j < J; j++) {
      if (j > 0) bones[facts.parents[j]].add(bones[j]);
      inverses.push(new THREE.Matrix4().makeTranslation(-arrays.joints[3 * j], -arrays.joints[3 * j + 1], -arrays.joints[3 * j + 2]));
    }
    const material = new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 0.85, side: THREE.DoubleSide });
    const mesh = new THREE.SkinnedMesh(geometry, material);
    mesh.frustumCulled = false; // its sphere would be that of the pose in which it was first drawn
    mesh.bindMode = THREE.DetachedBindMode; // the bones are in the world, not below the mesh
    mesh.bind(new THREE.Skeleton(bones, inverses), new THREE.Matrix4());
    mesh.visible = false;
    this.scene.add(bones[0], mesh);
    this.birds.push(mesh);
    console.assert(shapes.joints[0] === J);
  }

  /** Poses the birds. @param {Packed} poses @param {number} t position of the frame in its part, −1: no birds @param {Set<number>} selected */
  pose(poses, t, selected) {
    if (!this.ready) return;
    this.birds.forEach((mesh, n) => {
      const F = poses.shapes.valid[1], row = n * F + t;
      mesh.visible = t >= 0 && poses.arrays.valid[row] === 1;
      if (mesh.visible) this.poseBird(mesh, n, poses, row);
      /** @type {THREE.MeshStandardMaterial} */ (mesh.material).emissive.setHex(selected.has(this.facts.tracks[n].id) ? 0x3a3a10 : 0);
    });
    this.followBird(selected);
  }

  /** @param {THREE.SkinnedMesh} mesh @param {number} n @param {Packed} poses @param {number} row */
  poseBird(mesh, n, poses, row) {
    const { arrays } = poses, { facts, arrays: rest } = /** @type {Packed} */ (this.rig), J = facts.parents.length;
    const bones = mesh.skeleton.bones, step = poses.facts.turn_step;
    for (let j = 0; j < J; j++) {
      const k = 4 * (row * J + j);
      bones[j].quaternion.set(arrays.turns[k] * step, arrays.turns[k + 1] * step, arrays.turns[k + 2] * step, arrays.turns[k + 3] * step).normalize();
      if (j === 0) continue;
      const bone = arrays.bones ? arrays.bones[row * (J - 1) + j - 1] : 1, p = facts.parents[j];
      bones[j].position.set(
        bone * (rest.joints[3 * j] - rest.joints[3 * p]),
        bone * (rest.joints[3 * j + 1] - rest.joints[3 * p + 1]),
        bone * (rest.joints[3 * j + 2] - rest.joints[3 * p + 2]));
    }
    bones[0].position.set(arrays.place[3 * row], arrays.place[3 * row + 1], arrays.place[3 * row + 2]);
    bones[0].scale.setScalar(arrays.size[row]);
    /** @type {any} */ (mesh).boundingSphere = null; // clicks are tested against the sphere of this pose
    if (arrays.betas) this.shape(mesh, n, arrays.betas.subarray(row * (poses.shapes.betas[2]), (row + 1) * poses.shapes.betas[2]));
  }

  /** Gives a bird the shape of its coefficients. @param {THREE.SkinnedMesh} mesh @param {number} n @param {Float32Array} betas */
  shape(mesh, n, betas) {
    const before = this.shapeOf.get(n);
    if (before && betas.every((value, s) => Math.abs(value - before[s]) < 1e-4)) return;
    this.shapeOf.set(n, betas.slice());
    const { vertices, shapes } = /** @type {Packed} */ (this.rig).arrays, position = mesh.geometry.getAttribute("position");
    const target = /** @type {Float32Array} */ (position.array);
    target.set(vertices);
    betas.forEach((value, s) => {
      for (let i = 0; i < target.length; i++) target[i] += value * shapes[s * target.length + i];
    });
    position.needsUpdate = true;
    mesh.geometry.computeVertexNormals();
  }

  /** @param {Set<number>} selected */
  followBird(selected) {
    const n = this.facts.tracks.findIndex((track) => selected.has(track.id));
    const mesh = this.birds[n], controls = this.controls;
    if (this.mode !== "follow" || !mesh?.visible || !controls) return;
    mesh.updateMatrixWorld();
    const joints = mesh.skeleton.bones.map((bone) => bone.getWorldPosition(new THREE.Vector3()));
    const { center, radius } = new THREE.Box3().setFromPoints(joints).getBoundingSphere(new THREE.Sphere());
    const seen = this.orbit.position.clone().sub(controls.target);
    if (this.followed !== n) {
      // the bird fills the shorter side of the panel
      const { clientWidth: width, clientHeight: height } = this.parent;
      seen.setLength((1.1 * radius) / Math.sin((this.orbit.fov * Math.PI) / 360) / Math.min(1, width / Math.max(height, 1)));
    }
    this.orbit.position.copy(center).add(seen);
    controls.target.copy(center);
    this.followed = n;
    controls.update();
  }

  /** @param {string} mode `orbit`, `follow` or `film` */
  look(mode) {
    if (mode === "orbit" && this.mode !== mode) this.showAll();
    this.mode = mode;
    this.followed = -1;
    if (this.controls) this.controls.enabled = mode !== "film";
  }

  render() {
    if (!this.renderer) return;
    const { clientWidth: width, clientHeight: height } = this.parent;
    if (!width || !height) return;
    const size = this.renderer.getSize(new THREE.Vector2());
    if (size.x !== width || size.y !== height) this.renderer.setSize(width, height, false);
    const camera = this.mode === "film" ? this.film : this.orbit;
    if (camera === this.film) {
      // the whole picture of the film is inside the view
      const film = this.facts.size_px[0] / this.facts.size_px[1], own = width / height;
      const half = Math.tan((this.rig?.facts.camera.field_deg * Math.PI) / 360) * (own < film ? film / own : 1);
      camera.fov = (2 * Math.atan(half) * 180) / Math.PI;
    }
    const style = getComputedStyle(this.parent);
    this.scene.background = new THREE.Color(style.backgroundColor);
    this.rock.color.set(style.getPropertyValue("--rock"));
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    this.renderer.render(this.scene, camera);
  }

  /** @param {HTMLCanvasElement} canvas */
  watchClicks(canvas) {
    let down = [0, 0];
    canvas.addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; });
    canvas.addEventListener("click", (event) => {
      if (Math.hypot(event.clientX - down[0], event.clientY - down[1]) > 4) return; // it was a turn of the view
      const box = canvas.getBoundingClientRect(), ray = new THREE.Raycaster();
      const at = new THREE.Vector2((2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height);
      ray.setFromCamera(at, this.mode === "film" ? this.film : this.orbit);
      const hit = ray.intersectObjects(this.birds.filter((bird) => bird.visible), false)[0];
      if (hit) this.select(this.facts.tracks[this.birds.indexOf(/** @type {THREE.SkinnedMesh} */ (hit.object))].id, event.shiftKey);
    });
  }
}

/** Mixes the plumage with the colour of a track. @param {Float32Array} colours @param {string} css */
function tinted(colours, css) {
  const own = new THREE.Color(), track = new THREE.Color(css), mixed = new Float32Array(colours.length);
  for (let i = 0; i < colours.length; i += 3) {
    own.setRGB(colours[i], colours[i + 1], colours[i + 2], THREE.SRGBColorSpace).lerp(track, 0.45).toArray(mixed, i);
  }
  return mixed;
}
