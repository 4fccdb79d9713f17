// The page: its state, its controls, and the clock that film, birds and timeline share.
// @ts-check
import { arrays, isSaved, readFacts } from "viewer/data";
import { Corrections } from "viewer/corrections";
import { Film, FilmView, positionAt } from "viewer/film";
import { LedgeView } from "viewer/ledge";
import { Timeline } from "viewer/timeline";

/** @typedef {import("viewer/data").Facts} Facts */
/** @typedef {import("viewer/data").Packed} Packed */

const find = (/** @type {string} */ id) => /** @type {any} */ (document.getElementById(id));

/** One result with its two views. */
class Column {
  /** @param {number} number @param {import("viewer/data").ResultFacts} facts @param {boolean} film */
  constructor(number, facts, film) {
    this.number = number;
    this.facts = facts;
    this.positions = new Map(facts.frames.map((frame, t) => [frame, t]));
    this.section = document.createElement("section");
    this.section.className = "result";
    const title = document.createElement("h2");
    title.textContent = facts.name;
    this.section.append(title);
    /** @type {FilmView | null} */
    this.film = film ? new FilmView(this.panel("film"), facts, select) : null;
    this.ledge = new LedgeView(this.panel("ledge"), facts, select);
    find("results").append(this.section);
    this.ledge.message.textContent = "Placing the birds …";
    arrays(number, "rig").then((rig) => {
      this.ledge.open(rig);
      this.ledge.look(find("camera").value);
      refresh();
    }, (error) => { this.ledge.message.textContent = error.message; });
  }

  /** @param {string} name */
  panel(name) {
    const panel = document.createElement("div");
    panel.className = name;
    this.section.append(panel);
    return panel;
  }

  /** Loads a frame and the next frames; returns what is there already. @param {number} frame */
  async load(frame) {
    const t = this.positions.get(frame) ?? -1, size = this.facts.frames_of_part;
    if (t < 0) return { t, poses: null, outlines: null };
    const part = Math.floor(t / size), last = Math.floor((this.facts.frames.length - 1) / size);
    const outlines = this.film ? arrays(this.number, `outlines/${part}`) : null;
    const poses = await arrays(this.number, `poses/${part}`);
    if (part < last && t % size > size / 2) {
      arrays(this.number, `poses/${part + 1}`);
      if (this.film) arrays(this.number, `outlines/${part + 1}`);
    }
    const drawn = outlines && (await Promise.race([outlines, new Promise((done) => setTimeout(done, 15, null))]));
    if (outlines && !drawn) outlines.then(() => { if (frame === state.frames[state.i]) refresh(); });
    return { t: t % size, poses, outlines: drawn };
  }
}

const state = {
  /** @type {number[]} numbers of all frames */ frames: [],
  i: 0,
  /** @type {Set<number>} ids of tracks */ selected: new Set(),
  playing: false,
  /** @type {[number | null, number | null]} */ range: [null, null],
  /** @type {Column[]} */ columns: [],
  /** @type {Film | null} */ film: null,
  /** @type {Timeline | null} */ timeline: null,
  /** @type {Corrections | null} */ corrections: null,
  /** @type {(number | null)[]} */ times: [],
  busy: false,
  again: false,
};

/** @param {number} track @param {boolean} more whether further birds stay chosen */
function select(track, more) {
  const was = state.selected.has(track);
  if (!more) state.selected.clear();
  if (was && more) state.selected.delete(track);
  else state.selected.add(track);
  state.timeline?.drawStill(state.selected);
  state.corrections?.show();
  refresh();
}

/** Draws the present frame; while one is drawn, only the newest of further calls counts. */
async function refresh(seek = true) {
  if (state.busy) {
    state.again = true;
    return;
  }
  state.busy = true;
  do {
    state.again = false;
    await draw(seek);
  } while (state.again);
  state.busy = false;
  window.dispatchEvent(new Event("drawn"));
}

/** @param {boolean} seek whether the film has to be moved */
async function draw(seek) {
  const i = state.i, frame = state.frames[i], toFrame = seek && !state.playing;
  let picture = state.film?.picture ?? null;
  try {
    const [found] = await Promise.all([
      Promise.all(state.columns.map((column) => column.load(frame))),
      toFrame ? state.film?.seek(i) : null,
    ]);
    if (toFrame) picture = state.film?.picture ?? null;
    state.columns.forEach((column, c) => {
      const { t, poses, outlines } = found[c];
      column.film?.draw(picture, t, poses, outlines, state.selected, find("points").checked, find("camera").value === "follow");
      if (column.film) column.film.message.textContent = state.film?.problem ?? "";
      if (poses) column.ledge.pose(poses, t, state.selected);
      else column.ledge.pose(/** @type {any} */ ({ shapes: { valid: [0, 0] } }), -1, state.selected);
      column.ledge.render();
    });
  } catch (error) {
    find("notes").textContent = String(/** @type {Error} */ (error).message);
  }
  showNumbers();
}

function showNumbers() {
  const frame = state.frames[state.i], time = state.times[state.i];
  if (document.activeElement !== find("frame")) find("frame").value = frame;
  find("time").textContent = time === null ? "" : `${time.toFixed(3)} s`;
  find("play").textContent = state.playing ? "Pause" : "Play";
  const marks = (state.corrections?.marks ?? []).map((each) => state.frames.indexOf(each));
  state.timeline?.drawCursor(state.i, marks);
  if (!state.playing) {
    const parts = [`frame=${frame}`];
    if (time !== null) parts.push(`time=${time.toFixed(3)}`);
    if (state.selected.size) parts.push(`birds=${[...state.selected].join(",")}`);
    history.replaceState(null, "", `#${parts.join("&")}`);
  }
}

/** @param {number} i position of a frame */
function go(i) {
  state.i = Math.min(Math.max(i, 0), state.frames.length - 1);
  if (state.playing) pause();
  return refresh();
}

/** Moves to the next or the previous moment at which a pose becomes unsure or contradicted. @param {number} by */
function goToFlag(by) {
  const { flags, frames } = /** @type {Timeline} */ (state.timeline), T = frames.length;
  for (let i = state.i + by; i >= 0 && i < T; i += by) {
    for (let row = 0; row * T < flags.length; row++) {
      if (flags[row * T + i] > 1 && (i === 0 || flags[row * T + i - 1] <= 1)) {
        const track = /** @type {Timeline} */ (state.timeline).rows[row].id;
        if (!state.selected.has(track)) select(track, false);
        go(i);
        return;
      }
    }
  }
  find("notes").textContent = by > 0 ? "No later pose is flagged." : "No earlier pose is flagged.";
}

async function play() {
  state.playing = true;
  if (state.i >= state.frames.length - 1) state.i = 0;
  const speed = Number(find("speed").value), video = state.film?.video;
  if (video && state.film) {
    await state.film.move(video, state.i);
    state.film.picture = video;
    video.playbackRate = speed;
    await video.play();
    const film = state.film, { times_s } = film;
    const step = (/** @type {number} */ _, /** @type {VideoFrameCallbackMetadata} */ shown) => {
      if (!state.playing) return;
      const i = film.positionAt(shown.mediaTime);
      if (i >= 0) showPlayed(film, video, i);
      if (video.ended || shown.mediaTime >= times_s[times_s.length - 1] - 1e-3) pause();
      else video.requestVideoFrameCallback(step);
    };
    video.requestVideoFrameCallback(step);
    return;
  }
  const start = performance.now(), first = state.i;
  const known = state.times[first] !== null, times = /** @type {number[]} */ (state.times);
  while (state.playing && state.i < state.frames.length - 1) {
    const passed = (speed * (performance.now() - start)) / 1000;
    const next = known ? positionAt(times, times[first] + passed) : first + Math.floor(25 * passed);
    state.i = Math.min(Math.max(next, state.i), state.frames.length - 1);
    await state.film?.seek(state.i);
    await refresh(false);
    await new Promise((done) => requestAnimationFrame(done));
  }
  pause();
}

/** Shows a frame of the playing film; with frames between those of the results, its picture stays until the next one. @param {Film} film @param {HTMLVideoElement} video @param {number} i */
async function showPlayed(film, video, i) {
  if (film.gaps) film.picture = await createImageBitmap(video);
  state.i = i;
  refresh(false);
}

function pause() {
  state.playing = false;
  state.film?.video?.pause();
  refresh();
}

async function showValue() {
  const name = find("value").value, timeline = state.timeline;
  if (!timeline || !name) return;
  timeline.title = "computing …";
  timeline.values = null;
  timeline.drawStill(state.selected);
  const chosen = state.columns[0].facts.values.find((each) => each.name === name);
  try {
    const { arrays: found } = await arrays(0, `values/${name}`);
    timeline.values = spread(found.values, state.columns[0], NaN, Float32Array);
    timeline.title = chosen?.unit ? `${chosen.title} (${chosen.unit})` : chosen?.title ?? "";
  } catch (error) {
    find("notes").textContent = String(/** @type {Error} */ (error).message);
  }
  timeline.drawStill(state.selected);
}

/**
 * Values of a result at all frames of the page.
 * @template {Float32Array | Uint8Array} A
 * @param {A} values @param {Column} column @param {number} empty @param {new (size: number) => A} Type @returns {A}
 */
function spread(values, column, empty, Type) {
  const T = column.facts.frames.length, all = state.frames.length;
  const found = new Type(column.facts.tracks.length * all).fill(empty);
  state.frames.forEach((frame, i) => {
    const t = column.positions.get(frame);
    if (t === undefined) return;
    for (let n = 0; n < column.facts.tracks.length; n++) found[n * all + i] = values[n * T + t];
  });
  return /** @type {A} */ (found);
}

function watchControls() {
  const keys = /** @type {Record<string, () => void>} */ ({
    " ": () => (state.playing ? pause() : play()),
    ArrowRight: () => go(state.i + 1),
    ArrowLeft: () => go(state.i - 1),
    Home: () => go(0),
    End: () => go(state.frames.length - 1),
    n: () => goToFlag(1),
    p: () => goToFlag(-1),
    m: () => state.corrections?.mark(),
    "[": () => setRange(0),
    "]": () => setRange(1),
    Escape: () => { state.range = [null, null]; state.selected.clear(); rangeChanged(); },
  });
  document.addEventListener("keydown", (event) => {
    const target = /** @type {HTMLElement} */ (event.target);
    if (event.ctrlKey || event.metaKey || event.altKey || /INPUT|SELECT/.test(target.tagName)) return;
    if (event.shiftKey && event.key.startsWith("Arrow")) go(state.i + (event.key === "ArrowRight" ? 10 : -10));
    else if (event.key in keys) keys[event.key]();
    else return;
    event.preventDefault();
  });
  find("play").onclick = keys[" "];
  find("back").onclick = keys.ArrowLeft;
  find("on").onclick = keys.ArrowRight;
  find("next").onclick = keys.n;
  find("previous").onclick = keys.p;
  find("frame").onchange = () => go(nearest(Number(find("frame").value)));
  find("points").onchange = () => refresh();
  find("value").onchange = showValue;
  find("camera").onchange = () => {
    state.columns.forEach((column) => {
      column.ledge.look(find("camera").value);
      if (column.film) column.film.zoom = 1;
    });
    refresh();
  };
  for (const button of document.querySelectorAll("button, select")) {
    button.addEventListener("click", () => /** @type {HTMLElement} */ (button).tagName === "BUTTON" && /** @type {HTMLElement} */ (button).blur());
    button.addEventListener("change", () => /** @type {HTMLElement} */ (button).blur());
  }
  window.addEventListener("resize", () => { state.timeline?.drawStill(state.selected); refresh(); });
  window.addEventListener("hashchange", () => { if (readAddress()) refresh(); });
}

/** @param {0 | 1} end */
function setRange(end) {
  state.range[end] = state.frames[state.i];
  const [a, b] = state.range;
  if (a !== null && b !== null && a > b) state.range = end ? [b, b] : [a, a];
  rangeChanged();
}

function rangeChanged() {
  const timeline = /** @type {Timeline} */ (state.timeline);
  timeline.range = /** @type {[number | null, number | null]} */ (state.range.map((each) => (each === null ? null : state.frames.indexOf(each))));
  timeline.drawStill(state.selected);
  state.corrections?.show();
  refresh();
}

/** @param {number} frame number of a frame */
function nearest(frame) {
  let best = 0;
  state.frames.forEach((each, i) => { if (Math.abs(each - frame) < Math.abs(state.frames[best] - frame)) best = i; });
  return best;
}

/** Takes frame and birds from the address of the page; whether it names a frame. */
function readAddress() {
  const named = new URLSearchParams(location.hash.slice(1));
  if (named.has("birds")) {
    const known = new Set(state.columns.flatMap((column) => column.facts.tracks.map((track) => track.id)));
    state.selected = new Set((named.get("birds") ?? "").split(",").map(Number).filter((id) => known.has(id)));
  }
  const frame = Number(named.get("frame") ?? "x");
  if (!Number.isFinite(frame) || frame === state.frames[state.i]) return false;
  state.i = nearest(frame);
  return true;
}

/** Adds views for results that are not shown yet. @param {Facts} facts */
async function addColumns(facts) {
  for (let c = state.columns.length; c < facts.results.length; c++) {
    state.columns.push(new Column(c, facts.results[c], facts.film !== null));
  }
  find("results").classList.toggle("several", state.columns.length > 1);
}

async function open() {
  const facts = await readFacts();
  const frames = [...new Set(facts.results.flatMap((result) => result.frames))].sort((a, b) => a - b);
  state.frames = frames;
  /** @type {Map<number, number | null>} */
  const times = new Map(facts.results.flatMap((result) => result.frames.map((frame, t) => /** @type {[number, number | null]} */ ([frame, result.times_s[t]]))));
  state.times = frames.map((frame) => times.get(frame) ?? null);
  find("name").textContent = facts.results.map((result) => result.name).join(" | ");
  document.title = `${facts.results[0].name} – jaxfit view`;
  find("frame").min = frames[0];
  find("frame").max = frames[frames.length - 1];
  const film = facts.film;
  if (film) state.film = new Film(film, state.times, frames);
  const first = facts.results[0];
  state.timeline = new Timeline(find("rows"), first.tracks, frames, first.flag_colours, { seek: go, select });
  if (facts.corrections) {
    state.corrections = new Corrections(facts.corrections, {
      state: () => ({ frame: state.frames[state.i], selected: [...state.selected], range: state.range }),
      marked: () => showNumbers(),
      refitted: async () => { await addColumns(await readFacts()); refresh(); },
    });
  }
  find("value").replaceChildren(...first.values.map((each) => new Option(each.title, each.name)));
  find("legend").textContent = "Rows: low green is ok, orange unsure, high red contradicted by the detections. "
    + "The wheel zooms. Keys: space plays, arrows step, n and p go to flagged moments" + (facts.corrections ? ", [ and ] set a range, m marks a frame." : ".");
  find("notes").textContent = (facts.notes ?? []).concat(film ? [] : ["The film is not given: --video shows it."]).join(" ");
  await addColumns(facts);
  readAddress();
  watchControls();
  await state.film?.open();
  state.timeline.drawStill(state.selected);
  await refresh();
  const flagged = await arrays(0, "flags");
  state.timeline.flags = spread(flagged.arrays.flags, state.columns[0], 0, Uint8Array);
  state.timeline.drawStill(state.selected);
  document.body.dataset.ready = "yes";
  await showValue();
  showNumbers();
}

// for tests and for colleagues who look behind the page
Object.assign(window, { jaxfit: { state, go, refresh, isSaved } });
open().catch((error) => { find("notes").textContent = error.message; });
