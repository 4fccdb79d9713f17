// Corrections of tracks: a list with undo, the fit after them, and frames for labelling.
// @ts-check
import { change, work } from "viewer/data";

const find = (/** @type {string} */ id) => /** @type {HTMLElement} */ (document.getElementById(id));
const POLL_MS = 400;

export class Corrections {
  /**
   * @param {{edits: string[], file: string}} facts
   * @param {{state: () => {frame: number, selected: number[], range: [number | null, number | null]},
   *   marked: (frames: number[]) => void, refitted: () => void}} page
   */
  constructor(facts, page) {
    this.edits = [...facts.edits];
    this.page = page;
    /** @type {number[]} */
    this.marks = [];
    find("corrections").hidden = false;
    find("file").textContent = `Saved in ${facts.file}: jaxfit tracks --edits repeats them.`;
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
    const known = range[0] !== null && range[1] !== null;
    if (kind === "exclude" && !known) throw new Error("Choose a range: press [ at its first and ] at its last frame.");
    return `${kind} ${selected.join(",")}@${known ? `${range[0]}:${Number(range[1]) + 1}` : frame}`;
  }

  /** @param {string} kind */
  async add(kind) {
    try {
      await this.store([...this.edits, this.text(kind)]);
    } catch (error) {
      this.say(String(/** @type {Error} */ (error).message), true);
    }
  }

  async undo() {
    if (this.edits.length) await this.store(this.edits.slice(0, -1));
  }

  /** @param {string[]} edits */
  async store(edits) {
    try {
      const answer = await change("edits", { edits, known: this.edits });
      this.edits = answer.edits ?? edits;
      this.say(answer.problem ?? "", Boolean(answer.problem));
    } catch (error) {
      this.say(String(/** @type {Error} */ (error).message), true);
    }
    this.show();
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
    find("marked").textContent = this.marks.length ? `Frames ${this.marks.join(", ")}` : "None is marked.";
    find("edits").replaceChildren(...this.edits.map((edit) => {
      const item = document.createElement("li");
      item.textContent = edit;
      return item;
    }));
  }
}
