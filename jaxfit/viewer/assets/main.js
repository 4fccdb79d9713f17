// The page: its state, its controls, and the clock that film, birds and timeline share.
// @ts-check
import { arrays, change, forget, isSaved, readFacts } from "viewer/data";
import { Corrections } from "viewer/corrections";
import { Film, FilmView, positionAt } from "viewer/film";
import { LedgeView } from "viewer/ledge";
import { Timeline } from "viewer/timeline";

/** @typedef {import("viewer/data").Facts} Facts */
/** @typedef {import("viewer/data").Packed} Packed */

/** How long a moment is shown before its reasons are asked for and the address names it, milliseconds. */
const REST_MS = 120;
/** Keypoints that the page lists, from the worst on. */
const WORST = 7;
const find = (/** @type {string} */ id) => /** @type {any} */ (document.getElementById(id));

/** A bar whose dragging gives the panel after it another share of the two. */
function splitter() {
  const bar = document.createElement("div");
  bar.className = "splitter";
  bar.addEventListener("pointerdown", (event) => bar.setPointerCapture(event.pointerId));
  bar.addEventListener("pointermove", (event) => {
    const parent = bar.parentElement, panel = /** @type {HTMLElement | null} */ (bar.nextElementSibling);
    if (!bar.hasPointerCapture(event.pointerId) || !parent || !panel) return;
    const box = parent.getBoundingClientRect(), beside = getComputedStyle(parent).flexDirection === "row";
    const share = beside ? (box.right - event.clientX) / box.width : (box.bottom - event.clientY) / box.height;
    panel.style.flex = `0 0 ${100 * Math.min(Math.max(share, 0.08), 0.85)}%`;
    window.dispatchEvent(new Event("resize"));
  });
  return bar;
}

/** One result: the chosen bird, the whole film, and the birds in 3D. */
class Column {
  /** @param {number} number @param {import("viewer/data").ResultFacts} facts @param {boolean} film */
  constructor(number, facts, film) {
    this.number = number;
    this.facts = facts;
    this.positions = new Map(facts.frames.map((frame, t) => [frame, t]));
    this.section = document.createElement("section");
    this.section.className = "result";
    const title = document.createElement("h2"), others = document.createElement("div");
    title.textContent = facts.name;
    others.className = "others";
    this.section.append(title);
    /** The views of the film: the chosen bird, and the whole picture. @type {FilmView[]} */
    this.films = [];
    if (film) {
      this.films = [new FilmView(panel(this.section, "close"), facts, select, true), new FilmView(panel(others, "film"), facts, select)];
      this.section.append(splitter());
      others.append(splitter());
    }
    this.ledge = new LedgeView(panel(others, "ledge"), facts, select);
    this.section.append(others);
    if (number) find("results").append(splitter());
    find("results").append(this.section);
    this.ledge.message.textContent = "Placing the birds …";
    arrays(number, "rig").then((rig) => {
      this.ledge.open(rig);
      this.ledge.look(find("camera").value);
      refresh();
    }, (error) => { this.ledge.message.textContent = error.message; });
  }

  /** The view of the whole picture; null without a film. */
  get film() {
    return this.films[1] ?? null;
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

/** @param {HTMLElement} parent @param {string} name */
function panel(parent, name) {
  const made = document.createElement("div");
  made.className = name;
  parent.append(made);
  return made;
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
  /** the keypoint that the next click labels, −1 for the first that is not placed */ next: -1,
  busy: false,
  again: false,
};

/** @param {number} track @param {boolean} more whether further birds stay chosen */
function select(track, more) {
  state.next = -1;
  const was = state.selected.has(track);
  if (!more) state.selected.clear();
  if (was && more) state.selected.delete(track);
  else state.selected.add(track);
  state.timeline?.drawStill(state.selected);
  state.timeline?.reveal(state.timeline.rows.findIndex((row) => row.id === track));
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
      column.films.forEach((film) => {
        film.draw(picture, t, poses, outlines, state.selected, find("points").checked);
        film.message.textContent = state.film?.problem ?? "";
      });
      if (column.facts.labelling) column.ledge.poseModel(nextKeypoint());
      else if (poses) column.ledge.pose(poses, t, state.selected);
      else column.ledge.pose(/** @type {any} */ ({ shapes: { valid: [0, 0] } }), -1, state.selected);
      column.ledge.render();
    });
  } catch (error) {
    find("notes").textContent = String(/** @type {Error} */ (error).message);
  }
  if (toFrame) state.film?.sharpen(i).then((sharper) => { if (sharper) refresh(); });
  showNumbers();
  if (state.columns[0].facts.labelling) showKeypoints();
  else showWhy();
}

/** The keypoint that a click places on a film without a result: the chosen one, or the first that is not placed. */
function nextKeypoint() {
  const points = state.columns[0].films[0].points;
  return state.next >= 0 ? state.next : points.findIndex(({ placed }) => !placed);
}

/** Lists the keypoints of a film without a result, and which of them the chosen bird has. */
function showKeypoints() {
  const { facts, films: [film] } = state.columns[0], next = nextKeypoint(), { flags } = /** @type {Timeline} */ (state.timeline);
  const names = facts.keypoints.map((name) => name.replaceAll("_", " ")), why = find("why");
  const list = table([`Bird ${[...state.selected][0] ?? "–"}`, ""], names.map((name, k) => [name, film.points[k]?.placed ? (film.points[k].at ? "✓" : "hidden") : ""]));
  names.forEach((_, k) => {
    list.rows[k + 1].classList.toggle("next", k === next);
    list.rows[k + 1].onclick = () => { state.next = k; refresh(); };
  });
  const hint = document.createElement("p");
  hint.textContent = next >= 0 ? `Click the ${names[next]} of the bird in the film. The wheel zooms. N goes on without it.` : "All keypoints are labelled. Go to the next frame or bird.";
  why.replaceChildren(hint, list);
  why.hidden = false;
  const labelled = new Set((state.corrections?.edits ?? []).map((edit) => /^place (\d+@\d+)/.exec(edit)?.[1]));
  facts.tracks.forEach(({ id }, n) => state.frames.forEach((frame, i) => { flags[n * state.frames.length + i] = labelled.has(`${id}@${frame}`) ? 1 : 0; }));
  state.timeline?.drawStill(state.selected);
}

/** The change of the address that waits. */
let addressed = 0;

function showNumbers() {
  const frame = state.frames[state.i], time = state.times[state.i];
  if (document.activeElement !== find("frame")) find("frame").value = frame;
  find("time").textContent = time === null ? "" : `${time.toFixed(3)} s`;
  find("play").querySelector("path").setAttribute("d", state.playing ? "M4 2v12M11 2v12" : "M4 2l10 6-10 6z");
  const marks = (state.corrections?.marks ?? []).map((each) => state.frames.indexOf(each));
  state.timeline?.drawCursor(state.i, marks);
  if (!state.playing) {
    const parts = [`frame=${frame}`];
    if (time !== null) parts.push(`time=${time.toFixed(3)}`);
    if (state.selected.size) parts.push(`birds=${[...state.selected].join(",")}`);
    clearTimeout(addressed); // browsers allow few changes of the address a second
    addressed = setTimeout(() => history.replaceState(null, "", `#${parts.join("&")}`), REST_MS);
  }
}

/** The pose whose reasons the page shows. */
let explained = "";

/** Address of the reasons of a track's pose in the present frame; empty without a pose. @param {Column | undefined} column @param {number | undefined} track */
function reasonsOf(column, track) {
  const n = column?.facts.tracks.findIndex(({ id }) => id === track) ?? -1, t = column?.positions.get(state.frames[state.i]) ?? -1;
  return column && n >= 0 && t >= 0 ? `why/${n * column.facts.frames.length + t}` : "";
}

/** Shows why the pose of the chosen bird has its flag, beside the pose of a refit, and marks its worst keypoint. */
async function showWhy() {
  const track = [...state.selected][0], [column, refit] = state.columns, pose = reasonsOf(column, track), why = find("why");
  if (isSaved || state.playing || pose === explained) return;
  explained = pose;
  mark(null);
  why.classList.add("stale");
  await new Promise((done) => setTimeout(done, REST_MS)); // the reader may go on
  if (pose !== explained) return;
  why.hidden = !pose;
  if (!pose) return;
  const again = state.corrections ? reasonsOf(refit, track) : "";
  const [{ facts }, after] = await Promise.all([arrays(0, pose), again ? arrays(1, again) : null]);
  if (pose !== explained) return;
  const title = document.createElement("h2"), doubts = document.createElement("ul");
  title.append(`Bird ${track}: `, flagOf(column, facts.flag), ...(after ? [" → ", flagOf(column, after.facts.flag)] : []));
  doubts.append(...facts.doubts.map((/** @type {string} */ doubt) => Object.assign(document.createElement("li"), { textContent: doubt })));
  /** @type {any[]} */
  const keypoints = facts.keypoints.slice(0, WORST);
  const head = after ? ["before", "refit"] : ["here"];
  const refitted = (/** @type {any[]} */ rows, /** @type {string} */ by, /** @type {any} */ each) => rows.find((row) => row[by] === each[by]);
  const measures = table(["", ...head, "usual"], facts.measures.map((/** @type {any} */ each) => [
    each.title, each.here, ...(after ? [refitted(after.facts.measures, "title", each)?.here ?? ""] : []), each.usual]));
  facts.measures.forEach((/** @type {any} */ each, /** @type {number} */ row) => measures.rows[row + 1].classList.toggle("problem", each.bad));
  const worst = table(["Keypoints off by px", ...head, "usual", ...(after ? [] : ["conf."])], keypoints.map((each) => [each.name, each.px.toFixed(1),
    ...(after ? [refitted(after.facts.keypoints, "k", each)?.px.toFixed(1) ?? ""] : []), each.usual_px?.toFixed(1) ?? "", ...(after ? [] : [each.confidence.toFixed(2)])]));
  keypoints.forEach((each, row) => {
    worst.rows[row + 1].onmouseenter = () => mark(each);
    worst.rows[row + 1].onmouseleave = () => mark(keypoints[0]);
  });
  why.replaceChildren(title, doubts, measures, worst);
  why.classList.remove("stale");
  mark(keypoints[0] ?? null);
}

/** @param {Column} column @param {string} text */
function flagOf(column, text) {
  const flag = Object.assign(document.createElement("b"), { className: "flag", textContent: text });
  flag.style.background = column.facts.flag_colours[column.facts.flags.indexOf(text)] ?? "";
  return flag;
}

/** Draws one keypoint of the chosen bird in red. @param {{k: number, name: string, px: number} | null} keypoint */
function mark(keypoint) {
  for (const film of state.columns[0].films) {
    film.marked = keypoint && { k: keypoint.k, text: `${keypoint.name} ${keypoint.px.toFixed(1)} px` };
    film.redraw();
  }
}

/** @param {string[]} head @param {string[][]} rows */
function table(head, rows) {
  const made = document.createElement("table");
  for (const cells of [head, ...rows]) {
    const row = made.insertRow();
    for (const text of cells) row.insertCell().textContent = text;
  }
  return made;
}

/** @param {number} i position of a frame */
function go(i) {
  state.next = -1;
  state.i = Math.min(Math.max(i, 0), state.frames.length - 1);
  if (state.playing) pause();
  return refresh();
}

/** Leaves out the keypoint that the next click would label. */
function skipKeypoint() {
  const points = state.columns[0].films[0].points, next = nextKeypoint();
  state.next = points.findIndex(({ placed }, k) => k > next && !placed);
  refresh();
}

/** Moves to the next or the previous moment at which a pose becomes unsure or contradicted. @param {number} by */
function goToFlag(by) {
  if (state.columns[0].facts.labelling) return by > 0 ? skipKeypoint() : undefined;
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
  if (video) await state.film?.move(video, state.i);
  if (video && state.film?.video) {
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
    video.onended = () => state.playing && pause(); // no frame may come after the last one
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
  try {
    const [found, after] = await Promise.all([0, ...(timeline.after ? [1] : [])].map((c) => arrays(c, `values/${name}`)));
    timeline.values = spread(found.arrays.values, state.columns[0], NaN, Float32Array);
    if (timeline.after && after) timeline.after.values = spread(after.arrays.values, state.columns[1], NaN, Float32Array);
    timeline.title = "";
  } catch (error) {
    find("notes").textContent = String(/** @type {Error} */ (error).message);
  }
  timeline.drawStill(state.selected);
}

/** Shows flags and values of the refit beside those of the result, and how many flags have changed. */
async function showRefit() {
  const timeline = /** @type {Timeline} */ (state.timeline), column = state.columns[1];
  timeline.after = null;
  find("changes").replaceChildren();
  if (column && state.corrections) {
    timeline.after = { flags: spread((await arrays(1, "flags")).arrays.flags, column, 0, Uint8Array), values: null };
    const count = (/** @type {Uint8Array} */ flags) => flags.reduce((sums, flag) => { sums[flag]++; return sums; }, [0, 0, 0, 0]);
    const before = count(timeline.flags), after = count(timeline.after.flags);
    find("changes").append(table(["poses", "before", "refit"], column.facts.flags.map((flag, i) => [flag, `${before[i + 1]}`, `${after[i + 1]}`])));
  }
  explained = "";
  for (const { films: [close] } of state.columns) if (close) close.followed = -1; // all get one zoom
  await showValue();
  refresh();
}

/** Closes the refit; whether there was one. */
async function closeRefit() {
  if (!state.corrections || state.columns.length < 2) return false;
  await change("close", {});
  removeColumns();
  await showRefit();
  return true;
}

/** Removes the views of the refit. */
function removeColumns() {
  for (const column of state.columns.splice(1)) {
    column.section.previousElementSibling?.remove(); // the splitter
    column.section.remove();
    column.ledge.renderer?.dispose();
    forget(column.number);
  }
  find("results").classList.remove("several");
}

/**
 * Values of a result at all frames of the page, in the rows of the first result.
 * @template {Float32Array | Uint8Array} A
 * @param {A} values @param {Column} column @param {number} empty @param {new (size: number) => A} Type @returns {A}
 */
function spread(values, column, empty, Type) {
  const T = column.facts.frames.length, all = state.frames.length, rows = state.columns[0].facts.tracks;
  const found = new Type(rows.length * all).fill(empty);
  rows.forEach(({ id }, row) => {
    const n = column.facts.tracks.findIndex((track) => track.id === id);
    state.frames.forEach((frame, i) => {
      const t = column.positions.get(frame);
      if (n >= 0 && t !== undefined) found[row * all + i] = values[n * T + t];
    });
  });
  return /** @type {A} */ (found);
}

/** Keys: names of `KeyboardEvent.key` with their effect, for people, and what they do. @type {[string[], string, () => void][]} */
const KEYS = [
  [[" "], "Play or pause", () => (state.playing ? pause() : play())],
  [["ArrowLeft"], "One frame back; with shift, ten frames", () => go(state.i - 1)],
  [["ArrowRight"], "One frame on; with shift, ten frames", () => go(state.i + 1)],
  [["Home"], "First frame", () => go(0)],
  [["End"], "Last frame", () => go(state.frames.length - 1)],
  [["n"], "Next moment at which a pose becomes unsure or contradicted", () => goToFlag(1)],
  [["p"], "Previous such moment", () => goToFlag(-1)],
  [["ArrowUp"], "Choose the bird above in the timeline", () => chooseRow(-1)],
  [["ArrowDown"], "Choose the bird below in the timeline", () => chooseRow(1)],
  [["k"], "Show or hide the keypoints", () => find("points").click()],
  [["["], "First frame of a range", () => setRange(0)],
  [["]"], "Last frame of the range", () => setRange(1)],
  [["Escape"], "No bird and no range is chosen", () => { state.range = [null, null]; state.selected.clear(); rangeChanged(); }],
  [["?"], "These keys", () => find("keys").showModal()],
];
/** Keys that need a session of corrections. @type {typeof KEYS} */
const CORRECTING = [
  [["s"], "Swap two chosen birds", () => state.corrections?.add("swap")],
  [["c"], "Cut the chosen bird at this frame", () => state.corrections?.add("cut")],
  [["j"], "Join two chosen birds", () => state.corrections?.add("join")],
  [["Delete"], "Delete the chosen birds", () => state.corrections?.add("delete")],
  [["e"], "Exclude the chosen bird in the range, or in this frame", () => state.corrections?.add("exclude")],
  [["h"], "Hide the keypoint under the pointer, or show it where it is fitted", () => hideOrShow()],
  [["x"], "Exchange left and right of the chosen bird in this frame", () => state.corrections?.all("mirror")],
  [["a"], "Accept all keypoints of the chosen bird in this frame as labels", () => state.corrections?.all("accept")],
  [["Control+z", "u"], "Undo the last correction", () => state.corrections?.undo()],
  [["r"], "Refit", () => find("refit").click()],
  [["m"], "Mark the frame for labelling", () => state.corrections?.mark()],
];

/** @param {boolean} correcting whether the page takes corrections */
function watchControls(correcting) {
  const all = correcting ? [...KEYS, ...CORRECTING] : KEYS;
  const keys = new Map(all.flatMap(([names, , act]) => names.map((name) => /** @type {[string, () => void]} */ ([name, act]))));
  find("keys").querySelector("table").replaceChildren(...all.map(([names, effect]) => {
    const row = document.createElement("tr");
    row.insertCell().append(...names.map((name) => Object.assign(document.createElement("kbd"), { textContent: name === " " ? "space" : name.replace("Control", "Ctrl").replace("Arrow", "") })));
    row.insertCell().textContent = effect;
    return row;
  }));
  document.addEventListener("keydown", (event) => {
    const target = /** @type {HTMLElement} */ (event.target);
    if (event.altKey || /INPUT|SELECT/.test(target.tagName) || find("keys").open) return;
    if (event.shiftKey && /^Arrow(Left|Right)$/.test(event.key)) go(state.i + (event.key === "ArrowRight" ? 10 : -10));
    else {
      const act = keys.get(event.ctrlKey || event.metaKey ? `Control+${event.key}` : event.key);
      if (!act) return;
      act();
    }
    event.preventDefault();
  });
  for (const [button, key] of Object.entries({ play: " ", back: "ArrowLeft", on: "ArrowRight", next: "n", previous: "p", help: "?" })) {
    find(button).onclick = keys.get(key);
    find(button).title = `${all.find(([names]) => names.includes(key))?.[1]} (${key === " " ? "space" : key})`;
  }
  find("frame").onchange = () => go(nearest(Number(find("frame").value)));
  find("points").onchange = () => refresh();
  find("value").onchange = showValue;
  find("camera").onchange = () => {
    state.columns.forEach((column) => column.ledge.look(find("camera").value));
    refresh();
  };
  for (const control of document.querySelectorAll("button, select, input[type=checkbox]")) {
    control.addEventListener(control.tagName === "BUTTON" ? "click" : "change", () => /** @type {HTMLElement} */ (control).blur());
  }
  const redraw = () => { state.timeline?.drawStill(state.selected); refresh(); };
  window.addEventListener("resize", redraw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  window.addEventListener("hashchange", () => { if (readAddress()) refresh(); });
}

function hideOrShow() {
  const { corrections, hovered, points, facts, followed } = state.columns[0].films[0] ?? {};
  if (!corrections || hovered < 0 || !points[hovered]) return state.corrections?.say("Point at a keypoint first.", true);
  const track = facts.tracks[followed].id, { at, fitted } = points[hovered];
  if (at) state.corrections?.hide(track, hovered);
  else if (fitted) state.corrections?.place(track, hovered, fitted);
}

/** Chooses a neighbour of the chosen bird in the timeline. @param {number} by */
function chooseRow(by) {
  const rows = state.timeline?.rows ?? [], chosen = rows.findIndex((row) => state.selected.has(row.id));
  select(rows[Math.min(Math.max(chosen + by, 0), rows.length - 1)].id, false);
}

/** Gives buttons the icons that their `data-icon` describes, as lines in a square of 16. */
function drawIcons() {
  for (const button of document.querySelectorAll("[data-icon]")) {
    const icon = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    icon.setAttribute("viewBox", "0 0 16 16");
    icon.append(document.createElementNS("http://www.w3.org/2000/svg", "path"));
    icon.firstElementChild?.setAttribute("d", button.getAttribute("data-icon") ?? "");
    button.prepend(icon);
  }
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

/** @param {import("viewer/data").ResultFacts} facts */
function drawLegend(facts) {
  const meanings = ["the pose agrees with the detections", "the detections do not determine the pose", "the detections contradict the pose"];
  const entries = facts.flags.map((flag, i) => /** @type {[string, string, string]} */ (["swatch", facts.flag_colours[i], `${flag}: ${meanings[i]}`]));
  entries.push(["dot", "", "fitted keypoint"], ...(facts.detected ? [/** @type {[string, string, string]} */ (["dot ring", "", "detected keypoint, joined to the fitted one"])] : []), ["dot ring placed", "", "keypoint that you have placed"]);
  find("legend").append(...entries.map(([name, colour, text]) => {
    const entry = document.createElement("span"), key = document.createElement("i");
    key.className = name;
    key.style.background = colour;
    entry.append(key, text);
    return entry;
  }), "Click a bird to choose it, shift adds a second one. The wheel zooms, a double click resets the view.");
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
    state.corrections = new Corrections(facts.corrections, first, {
      changed: () => refresh(),
      show: (frame, track) => { select(track, false); go(nearest(frame)); },
      state: () => ({ frame: state.frames[state.i], selected: [...state.selected], range: state.range }),
      marked: () => showNumbers(),
      closed: closeRefit,
      refitted: async () => { removeColumns(); await addColumns(await readFacts()); await showRefit(); },
    });
  }
  find("value").replaceChildren(...first.values.map((each) => new Option(each.unit ? `${each.title} (${each.unit})` : each.title, each.name)));
  drawIcons();
  drawLegend(first);
  find("notes").textContent = (facts.notes ?? []).concat(film ? [] : ["The film is not given: --video shows it."]).join(" ");
  document.querySelector("main")?.after(splitter());
  await addColumns(facts);
  const close = state.columns[0].films[0];
  if (close) close.corrections = state.corrections;
  if (first.labelling && state.corrections) {
    document.body.classList.add("label");
    state.corrections.label = (track, at) => {
      const k = nextKeypoint();
      if (k >= 0) state.corrections?.place(track, k, at);
      skipKeypoint();
    };
  }
  readAddress();
  if (!location.hash.includes("birds=")) state.selected = new Set([first.tracks[0].id]);
  state.corrections?.show();
  watchControls(facts.corrections !== null);
  await state.film?.open();
  state.timeline.drawStill(state.selected);
  await refresh();
  const flagged = await arrays(0, "flags");
  state.timeline.flags = spread(flagged.arrays.flags, state.columns[0], 0, Uint8Array);
  state.timeline.drawStill(state.selected);
  document.body.dataset.ready = "yes";
  await showRefit();
}

// for tests and for colleagues who look behind the page
Object.assign(window, { jaxfit: { state, go, refresh, isSaved } });
open().catch((error) => { find("notes").textContent = error.message; });
