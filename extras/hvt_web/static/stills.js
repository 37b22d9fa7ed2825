// The strip of stills, each beside what the base stream showed there; a click opens the pair large.

import { make } from "./wall.js";
import { BASE_ALT, stillAlt, stillReason, stillTitle, stillWords } from "./words.js";

const MOST = 60;

/** @typedef {{id: string, edge: string, frame: number, captured: number, shows: string[], track: number | null,
 *    before: string, after: string, sureness: number, reason: string, why: string, stored: boolean, unread: boolean,
 *    doubted: boolean, note: string, earlier?: boolean, box: number[], crop: number[] | null}} Still x1, y1, x2, y2 in
 *    base pixels */

export class Stills {
  /** @param {HTMLElement} list @param {HTMLDialogElement} large */
  constructor(list, large) {
    this.list = list;
    this.large = large;
    /**
     * Those that came while somebody was about to click on another.
     * @type {Still[]}
     */
    this.pending = [];
    /** @type {Still[]} */
    this.known = [];
    this.pointed = false;
    list.addEventListener("pointerenter", (event) => {
      this.pointed = event.pointerType === "mouse";
    });
    list.addEventListener("pointerleave", () => {
      this.pointed = false;
      this.showPending();
    });
    list.addEventListener("focusout", () => setTimeout(() => this.showPending()));
  }

  reset() {
    this.pending = this.known = [];
    this.list.replaceChildren();
  }

  /** Another flight begins, whose tracks have the same numbers. */
  outdate() {
    const known = this.known.map((still) => ({ ...still, earlier: true }));
    this.reset();
    for (const still of (this.known = known)) this.show(still);
  }

  /** @param {Still} still */
  add(still) {
    this.known = [...this.known.slice(1 - 2 * MOST), still];
    this.pending = [...this.pending.slice(1 - MOST), still];
    this.showPending();
  }

  showPending() {
    if (this.pointed || this.list.contains(document.activeElement)) return;
    for (const still of this.pending.splice(0)) this.show(still);
  }

  /** @param {Still} still once for all objects of it of which the same is to be said: each is outlined */
  show(still) {
    const title = stillTitle(still);
    const same = [...this.list.querySelectorAll("button")].find((one) => one.dataset.still === still.id && one.dataset.said === title);
    if (same) {
      for (const frame of same.querySelectorAll("svg")) outline(still, frame);
      return;
    }
    const item = document.createElement("li");
    const button = make("button", "", item);
    button.dataset.still = still.id;
    button.dataset.said = title;
    const pair = make("span", "pair", button);
    for (const which of ["still", "base"]) {
      if (!still.shows.includes(which)) {
        make("span", "none", pair);
        continue;
      }
      const view = make("span", "view", pair);
      const picture = make("img", "", view);
      if (still.crop) outline(still, view.appendChild(framed(still.crop)));
      picture.src = address(still, which);
      picture.loading = "lazy";
      picture.alt = which === "still" ? stillAlt(still) : BASE_ALT;
    }
    const words = make("span", "words", button);
    words.textContent = stillWords(still);
    make("small", "", words).textContent = stillReason(still);
    button.addEventListener("click", () => this.open(still, button));
    this.list.prepend(item);
    while (this.list.children.length > MOST) this.list.lastElementChild?.remove();
  }

  /** @param {Still} still @param {HTMLElement} row of the list */
  open(still, row) {
    for (const which of ["still", "base"]) {
      const picture = this.part(`#large-${which}`);
      picture.closest("figure").hidden = !still.shows.includes(which);
      if (!still.shows.includes(which)) continue;
      picture.src = address(still, which);
      picture.parentElement.querySelector("svg")?.remove();
      const frame = row.querySelector("svg");
      if (frame) picture.parentElement.append(frame.cloneNode(true));
    }
    this.part("#large-text").textContent = stillTitle(still);
    this.large.showModal();
  }

  /** @param {string} selector @returns {any} */
  part(selector) {
    return this.large.querySelector(selector);
  }
}

/** @param {"svg" | "rect"} kind */
const drawing = (kind) => document.createElementNS("http://www.w3.org/2000/svg", kind);

/** @param {number[]} crop */
function framed([x, y, right, bottom]) {
  const frame = drawing("svg");
  frame.setAttribute("viewBox", [x, y, right - x, bottom - y].join(" "));
  return frame;
}

/**
 * Which of the objects of the still is meant.
 * @param {Still} still @param {Element} frame of its picture
 */
function outline({ box: [x, y, right, bottom] }, frame) {
  const outlined = frame.appendChild(drawing("rect"));
  for (const [name, value] of Object.entries({ x, y, width: right - x, height: bottom - y })) outlined.setAttribute(name, `${value}`);
}

/** @param {Still} still @param {string} which */
const address = (still, which) => `stills/${encodeURIComponent(still.edge)}/${still.id}/${which}`;
