// The link over the last four minutes: all bits, those of the base stream, and the budget.

import { minutesAgo, plotWords } from "./words.js";

const SECONDS = 240;
const GAP_MS = 3000; // a row comes each second: where none came, nothing is known

export class Plot {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    /** @type {Map<string, {at: number, total: number, base: number, budget: number}[]>} */
    this.rows = new Map();
    this.edge = "";
    this.now = 0;
    new ResizeObserver(() => this.draw()).observe(canvas);
    matchMedia("(prefers-color-scheme: light)").addEventListener("change", () => this.draw());
  }

  /**
   * What is at the right end: rows may have ended long ago.
   * @param {number} now
   */
  tick(now) {
    this.now = now;
    this.draw();
  }

  /** @param {string} edge @param {{at: number, total: number, base: number, budget: number}} row */
  add(edge, row) {
    const rows = this.rows.get(edge) ?? [];
    rows.push(row);
    while (rows.length > SECONDS + 5) rows.shift();
    this.rows.set(edge, rows);
  }

  /**
   * What was before this page was opened.
   * @param {string} edge @param {number[][]} rows
   */
  fill(edge, rows) {
    this.rows.set(edge, rows.map(([at, total, base, budget]) => ({ at, total, base, budget })));
    this.draw();
  }

  /** @param {string} edge */
  show(edge) {
    this.edge = edge;
    this.draw();
  }

  draw() {
    const { canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    const context = canvas.getContext("2d");
    const rows = this.rows.get(this.edge) ?? [];
    if (!context || !canvas.width || !rows.length) return;
    const style = getComputedStyle(document.documentElement);
    const colour = (/** @type {string} */ name) => style.getPropertyValue(name).trim();
    const newest = Math.max(this.now, rows[rows.length - 1].at);
    const top = 1.05 * Math.max(1, ...rows.map((row) => Math.max(row.total, row.budget)));
    const head = 18 * ratio;
    const foot = 16 * ratio;
    const x = (/** @type {number} */ at) => canvas.width * (1 - (newest - at) / (SECONDS * 1000));
    const y = (/** @type {number} */ bps) => head + (canvas.height - foot - head) * (1 - bps / top);
    context.font = `${11 * ratio}px system-ui, sans-serif`;
    context.fillStyle = colour("--faint");
    for (let minute = 1; minute < 4; minute++) {
      const at = x(newest - minute * 60000);
      context.fillRect(at, head, 1, canvas.height - foot - head);
      context.fillText(minutesAgo(minute), at + 3 * ratio, canvas.height - 4 * ratio);
    }
    const line = (/** @type {"total" | "base" | "budget"} */ what, /** @type {string} */ ink, /** @type {number[]} */ dash) => {
      context.beginPath();
      let before = -Infinity;
      for (const row of rows) {
        if (row.at - before > GAP_MS) context.moveTo(x(row.at), y(row[what]));
        else context.lineTo(x(row.at), y(row[what]));
        before = row.at;
      }
      context.strokeStyle = ink;
      context.lineWidth = 1.5 * ratio;
      context.setLineDash(dash);
      context.stroke();
      context.setLineDash([]);
    };
    line("budget", colour("--thin"), [5 * ratio, 4 * ratio]);
    line("base", colour("--faint"), []);
    line("total", colour("--accent"), []);
    let left = 6 * ratio;
    const words = plotWords(rows[rows.length - 1].budget);
    for (const [said, ink] of [[words.total, "--accent"], [words.base, "--faint"], [words.budget, "--thin"]]) {
      context.fillStyle = colour(ink);
      context.fillText(said, left, 12 * ratio);
      left += context.measureText(said).width + 12 * ratio;
    }
  }
}
