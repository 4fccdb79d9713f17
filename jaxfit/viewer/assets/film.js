// The film with outlines, keypoints and error ellipses of all birds.
// @ts-check
import { content, filmAddress } from "viewer/data";

/** @typedef {import("viewer/data").Packed} Packed */
/** @typedef {import("viewer/data").ResultFacts} ResultFacts */

const MISSING = -32768;
const CACHE_BYTES = 100e6;
/** How long a frame is shown before its picture gets all pixels of a wide film, milliseconds. */
const REST_MS = 150;
/** Largest distance from the beginning of a frame at which the film is stopped to show the frame, seconds. */
const MARGIN_S = 1e-3;
/** Longest wait for the picture of a film at rest, milliseconds. */
const SHOWN_MS = 200;
/** Largest distance of the pointer from a keypoint, pixels of the page. */
const NEAR_PX = 11;

/** Position of the last frame that begins before a time. @param {number[]} times @param {number} time @param {number} margin */
export function positionAt(times, time, margin = MARGIN_S) {
  let low = 0, high = times.length - 1;
  while (low < high) {
    const middle = Math.ceil((low + high) / 2);
    if (times[middle] <= time + margin) low = middle;
    else high = middle - 1;
  }
  return low;
}

/** The pictures of the film: a video element, or single pictures of the server. */
export class Film {
  /** @param {import("viewer/data").FilmFacts} facts @param {(number | null)[]} times_s @param {number[]} frames */
  constructor(facts, times_s, frames) {
    this.frames = frames;
    /** Times at which the film begins to show the frames. */
    this.times_s = /** @type {number[]} */ (facts.times_s ?? times_s);
    const steps = this.times_s.slice(1).map((time, i) => (time - this.times_s[i]) / (frames[i + 1] - frames[i]));
    this.margin = Math.min(MARGIN_S, ...steps.map((step) => step / 4));
    /** Whether the film has frames between those of the results. */
    this.gaps = frames.some((frame, i) => i > 0 && frame > frames[i - 1] + 1);
    this.pictures = facts.pictures;
    /** @type {HTMLVideoElement | null} */
    this.video = null;
    /** @type {CanvasImageSource | null} */
    this.picture = null;
    this.problem = "";
    /** The last frame that the video was moved to, and whether the video shows it. @type {{i: number, exact: boolean | null} | null} */
    this.moved = null;
    /** Pictures that were shown last, so that scrubbing to and fro does not wait for the decoder. @type {Map<number, ImageBitmap>} */
    this.shown = new Map();
    this.source = this.times_s.every((time) => time !== null) ? facts.source : null;
  }

  /** Opens the film. Where the browser cannot play it, single pictures take its place. */
  async open() {
    if (this.source === null) return;
    const video = document.createElement("video");
    video.muted = true;
    video.preload = "auto";
    video.playsInline = true;
    video.src = await filmAddress(this.source);
    const opened = await new Promise((done) => {
      video.onloadeddata = () => done(true);
      video.onerror = () => done(false);
    });
    if (opened) this.video = video;
  }

  /** Position of the frame that a playing film shows, −1 for a frame between those of the results. @param {number} time */
  positionAt(time) {
    const i = positionAt(this.times_s, time, this.margin);
    return Math.abs(this.times_s[i] - time) <= this.margin || !this.gaps ? i : -1;
  }

  /** Moves the video to a frame; whether the video shows this frame, null if the browser does not say so in time. @param {HTMLVideoElement} video @param {number} i position of the frame */
  async move(video, i) {
    const time = this.times_s[i] + this.margin;
    if (this.moved?.i === i && Math.abs(video.currentTime - time) < 1e-4) return this.moved.exact;
    const shown = new Promise((done) => video.requestVideoFrameCallback((_, { mediaTime }) => done(mediaTime)));
    await new Promise((done) => {
      video.onseeked = done;
      video.onerror = done;
      video.currentTime = time;
    });
    if (video.error) {
      this.video = null; // the film was removed or replaced
      return false;
    }
    // the picture may come after the event; at a variable rate, browsers may stop at a neighbour of the frame
    const mediaTime = await Promise.race([shown, new Promise((done) => setTimeout(done, SHOWN_MS, null))]);
    const exact = mediaTime === null ? null : Math.abs(mediaTime - time) <= 2 * this.margin;
    this.moved = { i, exact };
    return exact;
  }

  /** Shows a frame; resolves when its picture is there. @param {number} i position of the frame */
  async seek(i) {
    try {
      const picture = this.shown.get(i) ?? (this.pictures ? await createImageBitmap(new Blob([await content(`frames/${this.frames[i]}`)])) : await this.stopped(i));
      this.problem = "";
      this.keep(i, picture);
    } catch (error) {
      this.picture = null;
      this.problem = String(/** @type {Error} */ (error).message);
    }
  }

  /** The picture of the video at a frame. @param {number} i position of the frame */
  async stopped(i) {
    const { video } = this, exact = video && (await this.move(video, i));
    if (!video) throw new Error("The browser cannot play the film.");
    if (exact === false) throw new Error("The browser shows no picture of this frame of the film.");
    return createImageBitmap(video);
  }

  /** Replaces the picture of a wide film, which the server makes smaller, when the reader rests; whether it did so. @param {number} i position of the frame */
  async sharpen(i) {
    const { picture, video } = this;
    if (!this.pictures || !video || !(picture instanceof ImageBitmap) || picture.width >= video.videoWidth) return false;
    await new Promise((done) => setTimeout(done, REST_MS));
    if (this.picture !== picture || !(await this.move(video, i)) || this.picture !== picture) return false;
    this.keep(i, await createImageBitmap(video));
    return true;
  }

  /** @param {number} i position of the frame @param {ImageBitmap} picture */
  keep(i, picture) {
    this.picture = picture;
    this.shown.delete(i); // the newest is last
    this.shown.set(i, picture);
    for (const [old, { width, height }] of this.shown) {
      if (4 * width * height * this.shown.size <= CACHE_BYTES || old === i) break;
      this.shown.get(old)?.close();
      this.shown.delete(old);
    }
  }
}

/** One canvas with the film and the birds of a result: the whole picture, or the chosen bird. */
export class FilmView {
  /**
   * @param {HTMLElement} parent @param {ResultFacts} facts @param {(track: number, more: boolean) => void} select
   * @param {boolean} follows whether the view shows the chosen bird in place of the whole picture
   */
  constructor(parent, facts, select, follows = false) {
    this.facts = facts;
    this.follows = follows;
    this.canvas = document.createElement("canvas");
    this.message = document.createElement("p");
    this.message.className = "message";
    parent.append(this.canvas, this.message);
    /** @type {Packed | null} */
    this.outlines = this.poses = null;
    this.redraw = () => {};
    this.t = -1;
    /** The keypoint of the chosen bird that is drawn in red. @type {{k: number, text: string} | null} */
    this.marked = null;
    this.zoom = 1;
    /** What the view shows without zoom: the middle, the width and the height in pixels of the film. */
    this.home = { x: facts.size_px[0] / 2, y: facts.size_px[1] / 2, width: facts.size_px[0], height: facts.size_px[1] };
    /** The track of which `home` has the size. */
    this.followed = -1;
    /** Keypoints of the followed bird as they are drawn, with corrections. @type {{at: [number, number] | null, fitted: [number, number] | null, placed: boolean}[]} */
    this.points = [];
    /** The keypoint under the pointer, −1 for none. */
    this.hovered = -1;
    /** A keypoint that is dragged. @type {{k: number, at: [number, number]} | null} */
    this.moving = null;
    /** What corrections make of detected keypoints, and what a dragged keypoint does; null without corrections.
     * @type {{corrected: (track: number, detected: ([number, number] | null)[]) => {at: [number, number] | null, placed: boolean}[], place: (track: number, k: number, at: [number, number]) => void, label: ((track: number, at: [number, number]) => void) | null} | null} */
    this.corrections = null;
    /** How far the view was dragged, pixels of the film. */
    this.offset = [0, 0];
    this.watch(select);
  }

  /** @param {(track: number, more: boolean) => void} select */
  watch(select) {
    const { canvas } = this;
    /** @type {{x: number, y: number, moved: boolean, k: number} | null} */
    let drag = null;
    canvas.addEventListener("pointerdown", (event) => {
      drag = { x: event.clientX, y: event.clientY, moved: false, k: this.corrections ? this.pointAt(event) : -1 };
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!drag) return this.hover(this.pointAt(event));
      const { scale, ratio } = this.placement();
      drag.moved ||= Math.hypot(event.clientX - drag.x, event.clientY - drag.y) > 4;
      if (!drag.moved) return;
      if (drag.k >= 0) {
        this.moving = { k: drag.k, at: this.inFilm(event) };
        return this.redraw();
      }
      this.offset = [this.offset[0] - ((event.clientX - drag.x) * ratio) / scale, this.offset[1] - ((event.clientY - drag.y) * ratio) / scale];
      drag = { x: event.clientX, y: event.clientY, moved: true, k: -1 };
      this.redraw();
    });
    canvas.addEventListener("pointerup", (event) => {
      const clicked = drag && !drag.moved && drag.k < 0, n = clicked ? this.birdAt(event) : -1;
      drag = null;
      if (clicked && this.corrections?.label) this.corrections.label(this.facts.tracks[this.followed].id, this.inFilm(event));
      if (this.moving) this.corrections?.place(this.facts.tracks[this.followed].id, this.moving.k, this.moving.at);
      this.moving = null;
      if (n >= 0) select(this.facts.tracks[n].id, event.shiftKey);
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const [x, y] = this.inFilm(event), before = this.zoom;
      this.zoom = Math.min(Math.max(before * Math.exp(-event.deltaY / 400), this.follows ? 0.2 : 1), 20);
      // the point under the pointer stays
      const share = 1 - before / this.zoom;
      this.offset = [this.offset[0] + (x - this.home.x - this.offset[0]) * share, this.offset[1] + (y - this.home.y - this.offset[1]) * share];
      this.redraw();
    }, { passive: false });
    canvas.addEventListener("dblclick", () => {
      this.zoom = 1;
      this.offset = [0, 0];
      this.redraw();
    });
  }

  /** @param {number} k */
  hover(k) {
    if (k === this.hovered) return;
    this.hovered = k;
    this.canvas.style.cursor = k >= 0 && this.corrections ? "grab" : "";
    this.redraw();
  }

  /** The keypoint of the followed bird under the pointer, −1 for none; fitted ones count where nothing is detected. @param {MouseEvent} event */
  pointAt(event) {
    const [x, y] = this.inFilm(event), { scale, ratio } = this.placement();
    let best = -1, least = (NEAR_PX * ratio) / scale;
    this.points.forEach(({ at, fitted }, k) => {
      const shown = at ?? fitted;
      if (!shown) return;
      const [px, py] = shown, far = Math.hypot(px - x, py - y) + (at ? 0 : 1e-6);
      if (far < least) [best, least] = [k, far];
    });
    return best;
  }

  /** Scale and offset from film pixels to canvas pixels, and canvas pixels per pixel of the page. */
  placement() {
    const { home, canvas } = this;
    if (this.zoom === 1 && !this.follows) this.offset = [0, 0];
    const scale = Math.min(canvas.width / home.width, canvas.height / home.height) * this.zoom;
    const ratio = canvas.width / Math.max(canvas.getBoundingClientRect().width, 1);
    return { scale, ratio, x: canvas.width / 2 - (home.x + this.offset[0]) * scale, y: canvas.height / 2 - (home.y + this.offset[1]) * scale };
  }

  /** The point of the film under the pointer. @param {MouseEvent} event @returns {[number, number]} */
  inFilm(event) {
    const box = this.canvas.getBoundingClientRect(), { scale, ratio, x, y } = this.placement();
    return [((event.clientX - box.left) * ratio - x) / scale, ((event.clientY - box.top) * ratio - y) / scale];
  }

  /** Shows the chosen bird in the middle. Its size stays until another bird is chosen. @param {Packed} poses @param {number} t @param {Set<number>} selected */
  follow(poses, t, selected) {
    const n = this.facts.tracks.findIndex((track) => selected.has(track.id));
    if (n >= 0 && this.corrections?.label) this.followed = n;
    if (n < 0 || !poses.arrays.valid[n * poses.shapes.valid[1] + t]) return;
    const box = boxOf(poses, n, t);
    [this.home.x, this.home.y] = [box.x, box.y];
    if (n === this.followed) return;
    this.followed = n;
    this.zoom = 1;
    this.offset = [0, 0];
    this.home.width = this.home.height = 1.35 * Math.max(box.width, box.height, 8);
  }

  /**
   * Draws a frame.
   * @param {CanvasImageSource | null} picture
   * @param {number} t position of the frame in its parts, −1 if the result lacks the frame
   * @param {Packed | null} poses
   * @param {Packed | null} outlines
   * @param {Set<number>} selected ids of tracks
   * @param {boolean} points whether keypoints are drawn
   */
  draw(picture, t, poses, outlines, selected, points) {
    this.redraw = () => this.draw(picture, t, poses, outlines, selected, points);
    const box = this.canvas.getBoundingClientRect(), ratio = Math.min(window.devicePixelRatio, 2);
    const width = Math.max(1, Math.round(box.width * ratio)), height = Math.max(1, Math.round(box.height * ratio));
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
    const context = /** @type {CanvasRenderingContext2D} */ (this.canvas.getContext("2d", { willReadFrequently: true }));
    if (this.follows && poses && t >= 0) this.follow(poses, t, selected);
    const { scale, x, y } = this.placement(), [w, h] = this.facts.size_px;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, width, height);
    if (picture) context.drawImage(picture, x, y, w * scale, h * scale);
    context.setTransform(scale, 0, 0, scale, x, y);
    this.outlines = t < 0 ? null : outlines;
    this.poses = poses;
    this.t = t;
    this.points = [];
    if (t < 0) return;
    if (outlines) this.drawOutlines(context, outlines, t, selected, scale / ratio);
    if (!poses) return;
    this.facts.tracks.forEach((track, n) => {
      if (!poses.arrays.valid[n * poses.shapes.valid[1] + t] && !this.corrections?.label) return;
      if (points && this.follows && selected.has(track.id)) this.drawPoints(context, poses, n, t, scale / ratio);
      else if (!this.follows && this.facts.tracks.length > 1) drawNumber(context, track, boxOf(poses, n, t), scale / ratio);
    });
  }

  /** Paths of the birds at the present frame, [position of the track, path]. @param {Packed} outlines @param {number} t */
  *paths(outlines, t) {
    const { poses, lengths, points } = outlines.arrays, step = outlines.facts.step_px, count = outlines.facts.frames;
    let start = 0;
    for (let i = 0; i < poses.length; start += lengths[i], i++) {
      if (poses[i] % count !== t) continue;
      const path = new Path2D();
      for (let k = start; k < start + lengths[i]; k++) path.lineTo(points[2 * k] * step + 0.5, points[2 * k + 1] * step + 0.5);
      path.closePath();
      yield /** @type {[number, Path2D]} */ ([Math.floor(poses[i] / count), path]);
    }
  }

  /** @param {CanvasRenderingContext2D} context @param {Packed} outlines @param {number} t @param {Set<number>} selected @param {number} scale pixels of the page per pixel of the film */
  drawOutlines(context, outlines, t, selected, scale) {
    for (const [n, path] of this.paths(outlines, t)) {
      const { id, colour } = this.facts.tracks[n];
      context.strokeStyle = colour;
      context.lineWidth = (selected.has(id) ? 3 : 2) / scale;
      context.stroke(path);
    }
  }

  /** Draws the keypoints of a bird: fitted ones as dots, detected ones as rings that lines join to the dots. @param {CanvasRenderingContext2D} context @param {Packed} poses @param {number} n @param {number} t @param {number} scale pixels of the page per pixel of the film */
  drawPoints(context, poses, n, t, scale) {
    const { keypoints, detected, regions, valid } = poses.arrays, step = poses.facts.step_px;
    const [, F, K] = poses.shapes.keypoints, first = (n * F + t) * K, { colour } = this.facts.tracks[n];
    const at = (/** @type {any} */ array, /** @type {number} */ k) => pair(array, first + k, step);
    if (regions) this.drawRegions(context, poses, first, colour, scale);
    const found = Array.from({ length: K }, (_, k) => (detected && detected[2 * (first + k)] !== MISSING ? at(detected, k) : null));
    const points = (this.corrections?.corrected(this.facts.tracks[n].id, found) ?? found.map((each) => ({ at: each, placed: false })))
      .map((point, k) => ({ ...point, fitted: valid[n * F + t] ? at(keypoints, k) : null }));
    context.lineWidth = 1 / scale;
    context.strokeStyle = "#ffffff90";
    for (const pair of this.facts.skeleton) {
      const [a, b] = pair.map((k) => points[k].fitted ?? points[k].at);
      if (a && b) line(context, a, b);
    }
    if (this.moving && n === this.followed) Object.assign(points[this.moving.k], { at: this.moving.at, placed: true });
    points.forEach(({ at: seen, fitted, placed }, k) => {
      const marked = this.marked?.k === k && !placed;
      if (seen) {
        context.strokeStyle = marked ? "#ff4040" : placed ? "#2ee6ff" : "#ffe14d";
        context.lineWidth = (marked ? 3 : placed ? 2.5 : 1.5) / scale;
        if (fitted) line(context, seen, fitted);
        circle(context, seen, (marked ? 7 : 5) / scale);
        context.stroke();
      }
      if (!fitted) return;
      circle(context, fitted, 3 / scale);
      context.fillStyle = seen || !placed ? "#fff" : "#8889";
      context.strokeStyle = "#000a";
      context.lineWidth = 1 / scale;
      context.fill();
      context.stroke();
    });
    if (n !== this.followed) return;
    this.points = points;
    const named = this.hovered >= 0 ? this.hovered : this.marked?.k ?? -1;
    if (named < 0) return;
    const [x, y] = points[named].at ?? points[named].fitted ?? [-1e6, 0];
    const marked = this.marked?.k === named && !points[named].placed;
    const text = marked ? this.marked?.text ?? "" : this.facts.keypoints[named].replaceAll("_", " ");
    write(context, text, x + 12 / scale, y, scale, marked ? "#ff8f8f" : "#fff", "left");
  }

  /** @param {CanvasRenderingContext2D} context @param {Packed} poses @param {number} first @param {string} colour @param {number} scale */
  drawRegions(context, poses, first, colour, scale) {
    const { keypoints, regions } = poses.arrays, step = poses.facts.step_px, K = poses.shapes.keypoints[2];
    context.strokeStyle = colour;
    context.lineWidth = 1 / scale;
    for (let k = first; k < first + K; k++) {
      if (regions[3 * k] === MISSING) continue;
      const radius = this.facts.region_radius / 64;
      context.beginPath();
      context.ellipse(keypoints[2 * k] * step, keypoints[2 * k + 1] * step, regions[3 * k] * radius,
        regions[3 * k + 1] * radius, (regions[3 * k + 2] * 0.01 * Math.PI) / 180, 0, 2 * Math.PI);
      context.stroke();
    }
  }

  /** Position of the track under the pointer, −1 for none. @param {MouseEvent} event */
  birdAt(event) {
    const [px, py] = this.inFilm(event);
    const context = /** @type {CanvasRenderingContext2D} */ (this.canvas.getContext("2d", { willReadFrequently: true }));
    context.setTransform(1, 0, 0, 1, 0, 0);
    let found = -1;
    if (this.outlines) {
      for (const [n, path] of this.paths(this.outlines, this.t)) if (context.isPointInPath(path, px, py)) found = n;
    }
    if (found >= 0) return found;
    // before its outline is there, and on its number, a bird is its box
    const { poses, t } = this, { scale, ratio } = this.placement();
    return this.facts.tracks.findIndex((_, n) => {
      if (!poses || t < 0 || !poses.arrays.valid[n * poses.shapes.valid[1] + t]) return false;
      const box = boxOf(poses, n, t), top = box.y - box.height / 2 - (18 * ratio) / scale;
      return Math.abs(px - box.x) <= box.width / 2 && py >= top && py <= box.y + box.height / 2;
    });
  }
}

/** The box of the fitted keypoints of a bird: its middle, its width and its height. @param {Packed} poses @param {number} n @param {number} t */
function boxOf(poses, n, t) {
  const [, F, K] = poses.shapes.keypoints, step = poses.facts.step_px;
  const points = poses.arrays.keypoints.subarray(2 * (n * F + t) * K, 2 * (n * F + t + 1) * K);
  let [left, top, right, bottom] = [Infinity, Infinity, -Infinity, -Infinity];
  for (let k = 0; k < K; k++) {
    left = Math.min(left, points[2 * k] * step);
    right = Math.max(right, points[2 * k] * step);
    top = Math.min(top, points[2 * k + 1] * step);
    bottom = Math.max(bottom, points[2 * k + 1] * step);
  }
  return { x: (left + right) / 2, y: (top + bottom) / 2, width: right - left, height: bottom - top };
}

/** Writes the number of a track above its bird. @param {CanvasRenderingContext2D} context @param {import("viewer/data").Track} track @param {{x: number, y: number, height: number}} box @param {number} scale */
function drawNumber(context, track, box, scale) {
  write(context, String(track.id), box.x, box.y - box.height / 2 - 9 / scale, scale, track.colour, "center");
}

/** @param {CanvasRenderingContext2D} context @param {string} text @param {number} x @param {number} y @param {number} scale @param {string} colour @param {CanvasTextAlign} align */
function write(context, text, x, y, scale, colour, align) {
  context.font = `600 ${13 / scale}px system-ui, sans-serif`;
  context.textAlign = align;
  context.textBaseline = "middle";
  context.lineWidth = 3 / scale;
  context.strokeStyle = "#000c";
  context.fillStyle = colour;
  context.strokeText(text, x, y);
  context.fillText(text, x, y);
}

/** A point of packed positions, in pixels of the film. @param {Int16Array} array @param {number} k @param {number} step @returns {[number, number]} */
const pair = (array, k, step) => [array[2 * k] * step, array[2 * k + 1] * step];

/** @param {CanvasRenderingContext2D} context @param {[number, number]} from @param {[number, number]} to */
function line(context, from, to) {
  context.beginPath();
  context.moveTo(...from);
  context.lineTo(...to);
  context.stroke();
}

/** @param {CanvasRenderingContext2D} context @param {number[]} at @param {number} radius */
function circle(context, at, radius) {
  context.beginPath();
  context.arc(at[0], at[1], radius, 0, 2 * Math.PI);
}
