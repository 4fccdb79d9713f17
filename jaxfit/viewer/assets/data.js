// Reads what the page shows: from the server, or from a saved page.
// @ts-check

/** @typedef {{id: number, colour: string, status: string}} Track */
/** @typedef {{name: string, title: string, unit: string}} ValueName */
/**
 * @typedef {object} ResultFacts
 * @property {string} name
 * @property {Track[]} tracks
 * @property {number[]} frames numbers of the frames
 * @property {(number | null)[]} times_s
 * @property {[number, number]} size_px width and height of the film
 * @property {number} frames_of_part
 * @property {[number, number][]} skeleton
 * @property {string[]} keypoints
 * @property {number[]} opposite position of the same keypoint on the other side
 * @property {string[]} flags
 * @property {string[]} flag_colours
 * @property {ValueName[]} values
 * @property {number} region_radius radius of a region of 95 %, in standard deviations
 * @property {boolean} detected
 * @property {boolean} [labelling] whether the frames have no result, and are labelled
 */
/** @typedef {{source: string | null, times_s: number[] | null, pictures: boolean}} FilmFacts */
/** @typedef {{results: ResultFacts[], film: FilmFacts | null, corrections: {edits: string[], file: string, labels: string} | null, notes?: string[]}} Facts */
/** @typedef {{facts: any, arrays: Record<string, any>, shapes: Record<string, number[]>}} Packed */

/** @type {Record<string, any>} */
const TYPES = { f4: Float32Array, i2: Int16Array, u1: Uint8Array, u2: Uint16Array, u4: Uint32Array };
const PARTS_KEPT = 40;

/** Whether the page was saved, so that it has no server. */
export const isSaved = document.querySelector('meta[name="saved"]') !== null;

/** @type {Map<string, Promise<Packed>>} */
const packed = new Map();

/** Content that scripts of a saved folder add: path → base64 of gzip. @type {Record<string, string>} */
const added = {};
// @ts-ignore
window.jaxfitSaved = (/** @type {string} */ path, /** @type {string} */ text) => { added[path] = text; };

/** @param {string} text base64 */
function decoded(text) {
  return Uint8Array.from(atob(text.trim()), (character) => character.charCodeAt(0));
}

/** @param {string} path */
async function savedText(path) {
  const element = document.querySelector(`script[data-path="${path}"]`);
  if (element) return element.textContent ?? "";
  if (!(path in added)) {
    await new Promise((done, fail) => {
      const script = document.createElement("script");
      script.src = `data/${path.replaceAll("/", "-")}.js`;
      script.onload = done;
      script.onerror = () => fail(new Error(`${script.src} is missing: keep the folder of the page complete`));
      document.head.append(script);
    });
  }
  const text = added[path];
  delete added[path];
  return text;
}

/** @param {string} path @returns {Promise<ArrayBuffer>} */
export async function content(path) {
  if (isSaved) {
    const stream = new Blob([decoded(await savedText(path))]).stream();
    return new Response(stream.pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
  }
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(await problem(answer));
  return answer.arrayBuffer();
}

/** @param {Response} answer */
async function problem(answer) {
  const text = await answer.text();
  try {
    return JSON.parse(text).problem;
  } catch {
    return text || `the server answered ${answer.status}`;
  }
}

/** @param {ArrayBuffer} buffer @returns {Packed} */
export function unpacked(buffer) {
  const size = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
  /** @type {Packed} */
  const found = { facts: header.facts, arrays: {}, shapes: {} };
  for (const [name, { type, shape, start }] of Object.entries(header.arrays)) {
    const count = shape.reduce((/** @type {number} */ a, /** @type {number} */ b) => a * b, 1);
    found.arrays[name] = new TYPES[type](buffer, 4 + size + start, count);
    found.shapes[name] = shape;
  }
  return found;
}

/** @returns {Promise<Facts>} */
export async function readFacts() {
  return JSON.parse(new TextDecoder().decode(await content("facts")));
}

/** Arrays of a result, such as `rig`, `poses/3`; read once. @param {number} result @param {string} name */
export function arrays(result, name) {
  const path = `results/${result}/${name}`;
  let found = packed.get(path);
  if (!found) {
    found = content(path).then(unpacked);
    found.catch(() => packed.delete(path));
  } else {
    packed.delete(path); // the newest is last
  }
  packed.set(path, found);
  for (const old of packed.keys()) {
    if (packed.size <= PARTS_KEPT) break;
    if (!old.endsWith("rig") && !old.endsWith("flags")) packed.delete(old);
  }
  return found;
}

/** Forgets the arrays of a result whose number another result gets. @param {number} result */
export function forget(result) {
  for (const path of packed.keys()) if (path.startsWith(`results/${result}/`)) packed.delete(path);
}

/** The film of a saved page as an address. @param {string} source @returns {Promise<string>} */
export async function filmAddress(source) {
  if (!isSaved || !document.querySelector('script[data-path="film"]')) return source;
  const kind = document.querySelector('script[data-path="film"]')?.getAttribute("data-type") ?? "video/mp4";
  return URL.createObjectURL(new Blob([decoded(await savedText("film"))], { type: kind }));
}

/** Sends a change to the server; `edits` of the answer are those of the file, with a `problem` if others have written them. @param {string} action @param {object} sent @returns {Promise<any>} */
export async function change(action, sent) {
  const answer = await fetch(`change/${action}`, { method: "POST", body: JSON.stringify(sent) });
  if (answer.status === 409) return answer.json();
  if (!answer.ok) throw new Error(await problem(answer));
  return answer.json();
}

/** What the server works on. @returns {Promise<any>} */
export async function work() {
  return (await fetch("work")).json();
}
