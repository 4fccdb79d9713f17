// The timeline: a row for each bird with its flags, a curve of one value, and the present frame.
// @ts-check

/** @typedef {{id: number, colour: string}} Row */

const ROW = 16, LABEL = 46, CURVE = 64;
/** Share of the row that the flags ok, unsure and contradicted fill. */
const FILLED = [0, 0.55, 0.8, 1];

export class Timeline {
  /**
   * @param {HTMLElement} parent
   * @param {Row[]} rows
   * @param {number[]} frames
   * @param {string[]} colours of the flags ok, unsure, contradicted
   * @param {{seek: (i: number) => void, select: (track: number, more: boolean) => void}} actions
   */
  constructor(parent, rows, frames, colours, actions) {
    this.parent = parent;
    this.rows = rows;
    this.frames = frames;
    this.colours = ["", ...colours];
    this.still = document.createElement("canvas");
    this.cursor = document.createElement("canvas");
    this.cursor.className = "cursor";
    parent.append(this.still, this.cursor);
    /** @type {Uint8Array} */
    this.flags = new Uint8Array(rows.length * frames.length);
    /** @type {Float32Array | null} */
    this.values = null;
    /** Flags and values of the refit, in the rows of the result. @type {{flags: Uint8Array, values: Float32Array | null} | null} */
    this.after = null;
    this.title = "";
    this.ink = this.soft = this.chosen = this.band = "#888";
    this.height = CURVE + ROW * rows.length;
    this.range = /** @type {[number | null, number | null]} */ ([null, null]);
    this.watch(actions);
  }

  /** @param {{seek: (i: number) => void, select: (track: number, more: boolean) => void}} actions */
  watch(actions) {
    let pressed = false;
    const seek = (/** @type {PointerEvent} */ event) => {
      const box = this.still.getBoundingClientRect();
      const share = (event.clientX - box.left - LABEL) / (box.width - LABEL);
      actions.seek(Math.round(Math.min(Math.max(share, 0), 1) * (this.frames.length - 1)));
    };
    this.still.addEventListener("pointerdown", (event) => {
      const box = this.still.getBoundingClientRect();
      const row = Math.floor((event.clientY - box.top - CURVE) / ROW);
      if (row >= 0 && row < this.rows.length) actions.select(this.rows[row].id, event.shiftKey);
      if (event.clientX - box.left < LABEL) return;
      pressed = true;
      this.still.setPointerCapture(event.pointerId);
      seek(event);
    });
    this.still.addEventListener("pointermove", (event) => pressed && seek(event));
    this.still.addEventListener("pointerup", () => { pressed = false; });
  }

  /** Scrolls to a row. @param {number} n */
  reveal(n) {
    const top = CURVE + n * ROW, { scrollTop, clientHeight } = this.parent;
    if (top < scrollTop || top + ROW > scrollTop + clientHeight) this.parent.scrollTop = top - clientHeight / 2;
  }

  /** @param {number} i position of a frame @param {number} width */
  x(i, width) {
    return LABEL + ((width - LABEL) * i) / Math.max(this.frames.length - 1, 1);
  }

  /** @param {HTMLCanvasElement} canvas */
  context(canvas) {
    const width = this.parent.clientWidth, ratio = Math.min(window.devicePixelRatio, 2);
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(this.height * ratio);
    canvas.style.width = `${width}px`;
    canvas.style.height = `${this.height}px`;
    const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d", { willReadFrequently: true }));
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, this.height);
    return { context, width };
  }

  /** Draws all but the present frame. @param {Set<number>} selected */
  drawStill(selected) {
    const { context, width } = this.context(this.still), style = getComputedStyle(this.parent);
    [this.ink, this.soft, this.chosen, this.band] = ["--ink", "--soft", "--chosen", "--band"].map((name) => style.getPropertyValue(name));
    context.font = "11px system-ui, sans-serif";
    context.textBaseline = "middle";
    this.rows.forEach(({ id, colour }, n) => {
      const top = CURVE + n * ROW;
      context.fillStyle = selected.has(id) ? this.chosen : this.band;
      context.fillRect(0, top, width, ROW - 1);
      context.fillStyle = colour;
      context.fillRect(2, top + 3, 8, ROW - 6);
      context.fillStyle = this.ink;
      context.fillText(String(id), 14, top + ROW / 2 + 0.5, LABEL - 16);
      const half = (ROW - 4) / 2;
      if (this.after) this.drawFlags(context, this.after.flags, n, top + ROW - 2, half, width);
      this.drawFlags(context, this.flags, n, top + ROW - 2 - (this.after ? half : 0), this.after ? half - 1 : 2 * half, width);
    });
    this.drawCurves(context, width, selected);
    if (this.range[0] !== null && this.range[1] !== null) {
      context.fillStyle = "#3366cc28";
      const left = this.x(this.range[0], width);
      context.fillRect(left, 0, Math.max(this.x(this.range[1], width) - left, 2), this.height);
    }
  }

  /**
   * Each column shows the worst flag of its frames.
   * @param {CanvasRenderingContext2D} context @param {Uint8Array} flags @param {number} n @param {number} bottom @param {number} height @param {number} width
   */
  drawFlags(context, flags, n, bottom, height, width) {
    const T = this.frames.length, columns = Math.max(1, Math.min(T, Math.floor(width - LABEL)));
    for (let c = 0; c < columns; c++) {
      const from = Math.floor((c * T) / columns), to = Math.max(Math.floor(((c + 1) * T) / columns), from + 1);
      let worst = 0;
      for (let t = from; t < to; t++) worst = Math.max(worst, flags[n * T + t]);
      if (!worst) continue;
      const left = LABEL + ((width - LABEL) * c) / columns, high = height * FILLED[worst];
      context.fillStyle = this.colours[worst];
      context.fillRect(left, bottom - high, (width - LABEL) / columns + 0.5, high);
    }
  }

  /** Draws the values of the result, dashed beside those of a refit. @param {CanvasRenderingContext2D} context @param {number} width @param {Set<number>} selected */
  drawCurves(context, width, selected) {
    const shown = [this.values, this.after?.values].filter((each) => each instanceof Float32Array);
    context.fillStyle = this.soft;
    context.fillText(this.title, LABEL + 4, 8);
    let low = Infinity, high = -Infinity;
    for (const values of shown) for (const value of values) if (Number.isFinite(value)) { low = Math.min(low, value); high = Math.max(high, value); }
    if (low > high) return;
    if (low === high) { low -= 0.5; high += 0.5; }
    const y = (/** @type {number} */ value) => CURVE - 5 - ((CURVE - 20) * (value - low)) / (high - low);
    shown.forEach((values, i) => this.drawCurve(context, values, i < shown.length - 1, y, width, selected));
    context.setLineDash([]);
    context.textAlign = "right";
    context.fillText(short(high), LABEL - 4, y(high));
    context.fillText(short(low), LABEL - 4, y(low) - 3);
    context.textAlign = "left";
  }

  /** @param {CanvasRenderingContext2D} context @param {Float32Array} values @param {boolean} before @param {(value: number) => number} y @param {number} width @param {Set<number>} selected */
  drawCurve(context, values, before, y, width, selected) {
    const T = this.frames.length, step = Math.max(1, Math.floor(T / (4 * width)));
    context.setLineDash(before ? [3, 3] : []);
    const order = this.rows.map((_, n) => n).sort((a, b) => Number(selected.has(this.rows[a].id)) - Number(selected.has(this.rows[b].id)));
    for (const n of order) {
      const chosen = selected.has(this.rows[n].id);
      context.strokeStyle = chosen || !selected.size ? this.rows[n].colour : `${this.rows[n].colour}66`;
      context.lineWidth = chosen && !before ? 2 : 1;
      context.beginPath();
      let open = false;
      for (let t = 0; t < T; t += step) {
        const value = values[n * T + t];
        if (!Number.isFinite(value)) { open = false; continue; }
        if (open) context.lineTo(this.x(t, width), y(value)); else context.moveTo(this.x(t, width), y(value));
        open = true;
      }
      context.stroke();
    }
  }

  /** @param {number} i position of the present frame @param {number[]} marks positions of frames marked for labelling */
  drawCursor(i, marks) {
    const { context, width } = this.context(this.cursor);
    context.fillStyle = "#7b1fa2";
    for (const mark of marks) context.fillRect(this.x(mark, width) - 1.5, 0, 3, 7);
    context.fillStyle = this.ink;
    context.fillRect(this.x(i, width) - 0.75, 0, 1.5, this.height);
  }
}

/** @param {number} value */
function short(value) {
  return Math.abs(value) >= 100 ? value.toFixed(0) : Number(value.toPrecision(2)).toString();
}
