// Corrections of tracks: a list with undo, the fit after them, and frames for labelling.
// @ts-check
import { change, work } from "viewer/data";

const find = (/** @type {string} */ id) => /** @type {HTMLElement} */ (document.getElementById(id));
const POLL_MS = 400;
/** An edit of keypoints: kind, track, frame, keypoint, x, y. */
const POINT = /^(place|hide|mirror|accept) (\d+)@(\d+)(?: (\S.*?))?(?: (-?[\d.]+),(-?[\d.]+))?$/;

export class Corrections {
  /**
   * @param {{edits: string[], file: string, labels: string}} facts
   * @param {import("viewer/data").ResultFacts} result
   * @param {{state: () => {frame: number, selected: number[], range: [number | null, number | null]}, changed: () => void, closed: () => Promise<boolean>,
   *   show: (frame: number, track: number) => void, marked: (frames: number[]) => void, refitted: () => void}} page
   */
  constructor(facts, result, page) {
    this.edits = [...facts.edits];
    this.result = result;
    this.page = page;
    /** @type {number[]} */
    this.marks = [];
    find("corrections").hidden = false;
    find("file").textContent = `Saved in ${facts.file}; placed keypoints are also labels in ${facts.labels}.`;
    /** Places the next keypoint of a bird without a result. @type {((track: number, at: [number, number]) => void) | null} */
    this.label = null;
    this.others = new BroadcastChannel(location.pathname);
    this.others.onmessage = ({ data }) => {
      if (data === "open?") this.others.postMessage("open");
      else this.say("This result is open in a second page. Correct it in one of the two.", true);
    };
    this.others.postMessage("open?");
    for (const button of document.querySelectorAll("[data-edit]")) {
      button.addEventListener("click", () => this.add(button.getAttribute("data-edit") ?? ""));
    }
    find("undo").addEventListener("click", () => this.undo());
    find("refit").addEventListener("click", () => this.start("refit", { known: this.edits }));
    find("mark").addEventListener("click", () => this.mark());
    find("write").addEventListener("click", () => this.start("mark", { frames: this.marks }));
    this.show();
  }

  /** The edit of a button in the words of `jaxfit tracks`; throws what is missing. @param {string} kind */
  text(kind) {
    const { frame, selected, range } = this.page.state();
    const birds = kind === "swap" || kind === "join" ? 2 : 1;
    if (kind === "delete" ? !selected.length : selected.length !== birds) {
      throw new Error(birds === 2 ? "Choose two birds: click one, then the other with shift." : "Choose one bird by a click.");
    }
    if (kind === "join" || kind === "delete") return `${kind} ${selected.join(",")}`;
    if (kind === "cut") return `cut ${selected[0]}@${frame}`;
    if (range[0] !== null && range[1] !== null) return `${kind} ${selected.join(",")}@${range[0]}:${range[1] + 1}`;
    return `${kind} ${selected.join(",")}@${frame}${kind === "exclude" ? `:${frame + 1}` : ""}`;
  }

  /** @param {string} kind */
  async add(kind) {
    try {
      await this.store([...this.edits, this.text(kind)]);
    } catch (error) {
      this.say(String(/** @type {Error} */ (error).message), true);
    }
  }

  /**
   * The keypoints of a bird at the present frame after the corrections.
   * @param {number} track @param {([number, number] | null)[]} detected
   */
  corrected(track, detected) {
    const { frame } = this.page.state(), { keypoints, opposite } = this.result;
    let found = detected.map((at) => ({ at, placed: false }));
    for (const edit of this.edits) {
      const [, kind, id, number, name, x, y] = POINT.exec(edit) ?? [];
      if (Number(id) !== track || Number(number) !== frame) continue;
      const k = keypoints.indexOf(name);
      if (kind === "mirror") found = found.map((_, i) => found[opposite[i]]);
      else if (kind === "accept") found = found.map(({ at, placed }) => ({ at, placed: placed || at !== null }));
      else if (k >= 0) found[k] = { at: kind === "place" ? [Number(x), Number(y)] : null, placed: true };
    }
    return found;
  }

  /** Says where a keypoint is, or hides it outside the picture. @param {number} track @param {number} k @param {[number, number]} at */
  place(track, k, [x, y]) {
    const [width, height] = this.result.size_px, inside = x >= 0 && y >= 0 && x <= width && y <= height;
    const start = `${track}@${this.page.state().frame} ${this.result.keypoints[k]}`;
    return this.point(inside ? `place ${start} ${x.toFixed(1)},${y.toFixed(1)}` : `hide ${start}`,
      inside ? "" : "The keypoint is outside the picture, so it is hidden.");
  }

  /** @param {number} track @param {number} k */
  hide(track, k) {
    return this.point(`hide ${track}@${this.page.state().frame} ${this.result.keypoints[k]}`);
  }

  /** Says something about all keypoints of a bird. @param {"mirror" | "accept"} kind */
  all(kind) {
    const { frame, selected } = this.page.state();
    if (selected.length !== 1) return this.say("Choose one bird by a click.", true);
    return this.point(`${kind} ${selected[0]}@${frame}`);
  }

  /** Stores an edit of keypoints; it replaces the last edit of the same keypoint. @param {string} edit @param {string} text */
  async point(edit, text = "") {
    const target = (/** @type {string | undefined} */ each) => POINT.exec(each ?? "")?.slice(2, 5).join();
    const again = POINT.exec(edit)?.[4] && target(edit) === target(this.edits.at(-1));
    await this.store([...(again ? this.edits.slice(0, -1) : this.edits), edit]);
    if (text) this.say(text);
  }

  /** Closes the refit, or else removes the last edit. */
  async undo() {
    if (await this.page.closed()) return this.say("The refit is closed; its folder stays.");
    if (this.edits.length) await this.store(this.edits.slice(0, -1));
  }

  /** @param {string[]} edits */
  async store(edits) {
    try {
      const answer = await change("edits", { edits, known: this.edits });
      this.edits = answer.edits;
      this.say(answer.problem ?? "", Boolean(answer.problem));
    } catch (error) {
      this.say(String(/** @type {Error} */ (error).message), true);
    }
    this.show();
    this.page.changed();
  }

  mark() {
    const { frame } = this.page.state();
    this.marks = this.marks.includes(frame) ? this.marks.filter((each) => each !== frame) : [...this.marks, frame].sort((a, b) => a - b);
    this.show();
    this.page.marked(this.marks);
  }

  /** @param {string} action @param {object} sent */
  async start(action, sent) {
    try {
      const answer = await change(action, sent);
      if (answer.edits) {
        this.edits = answer.edits;
        this.show();
        throw new Error(answer.problem);
      }
    } catch (error) {
      this.say(String(/** @type {Error} */ (error).message), true);
      return;
    }
    const bar = /** @type {HTMLProgressElement} */ (find("progress"));
    bar.hidden = false;
    let state = await work();
    while (!state.done) {
      bar.value = state.share;
      this.say(`${state.task} … ${state.seconds.toFixed(0)} s`);
      await new Promise((done) => setTimeout(done, POLL_MS));
      state = await work();
    }
    bar.hidden = true;
    this.say(state.problem || `Written: ${state.out}`, Boolean(state.problem));
    if (!state.problem && action === "refit") this.page.refitted();
  }

  /** @param {string} text @param {boolean} problem */
  say(text, problem = false) {
    find("state").textContent = text;
    find("state").classList.toggle("problem", problem);
  }

  /** Shows edits, marks, and what is chosen. */
  show() {
    const { selected, range } = this.page.state();
    find("chosen").textContent = selected.length ? `Chosen: ${selected.join(", ")}` : "Click a bird; shift adds a second.";
    find("range").textContent = range[0] !== null || range[1] !== null
      ? `Range: frames ${range[0] ?? "…"} to ${range[1] ?? "…"}` : "Range: press [ and ], escape removes it.";
    /** @type {HTMLButtonElement} */ (find("refit")).disabled = !this.edits.length;
    find("marked").textContent = this.marks.length ? `Frames ${this.marks.join(", ")}` : "None is marked.";
    find("edits").replaceChildren(...this.edits.map((edit) => {
      const item = document.createElement("li"), [, track, frame] = /(\d+)[^@]*@(\d+)/.exec(edit) ?? [];
      item.textContent = edit;
      if (frame) item.onclick = () => this.page.show(Number(frame), Number(track));
      return item;
    }));
  }
}
