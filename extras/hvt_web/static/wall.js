// The wall: each edge with a small picture, its link, its budget and what happened last.

import * as words from "./words.js";

const OLD_MS = 10000; // a thumbnail comes once a second, or with each frame

/** @typedef {{link: string, since: number, total: number | null, budget: number | null}} EdgeState */

export class Wall {
  /** @param {HTMLElement} root @param {HTMLElement} nobody @param {(edge: string) => void} onChoose */
  constructor(root, nobody, onChoose) {
    this.root = root;
    this.nobody = nobody;
    this.onChoose = onChoose;
    this.others = "{}";
    /** @type {Map<string, Record<string, any>>} */
    this.cards = new Map();
  }

  /** @param {string} edge */
  card(edge) {
    const known = this.cards.get(edge);
    if (known) return known;
    const button = document.createElement("button");
    button.className = "edge";
    button.dataset.edge = edge;
    const picture = make("img", "picture", button);
    picture.alt = "";
    picture.width = 320;
    picture.height = 180;
    const about = make("span", "about", button);
    const age = make("span", "card-age", button);
    const top = make("span", "top", about);
    const light = make("span", "light", top);
    const name = make("b", "", top);
    make("bdi", "", name).textContent = name.title = edge;
    const middle = make("span", "top", about);
    const state = make("span", "state", middle);
    const bar = make("meter", "bar", middle);
    bar.setAttribute("aria-label", words.BUDGET_SHARE);
    const last = make("span", "last", about);
    button.addEventListener("click", () => this.onChoose(edge));
    const card = { button, picture, light, state, bar, last, age, captured: 0, link: "" };
    this.cards.set(edge, card);
    this.nobody.hidden = true;
    const after = [...this.cards.keys()].sort(byNumber);
    const marked = /** @type {HTMLElement | null} */ (this.root.querySelector("[aria-current=true]"));
    const before = marked?.offsetLeft ?? 0;
    this.root.insertBefore(button, this.cards.get(after[after.indexOf(edge) + 1])?.button ?? null);
    if (marked) this.root.scrollLeft += marked.offsetLeft - before; // else it would leave the screen
    return card;
  }

  /** @param {string} edge @param {Uint8Array} data @param {number} captured */
  thumbnail(edge, data, captured) {
    const card = this.card(edge);
    const { picture } = card;
    card.captured = captured;
    URL.revokeObjectURL(picture.src); // at once: one that was never loaded would stay in memory
    picture.src = URL.createObjectURL(new Blob([data], { type: "image/jpeg" }));
  }

  /**
   * How old the newest picture of an edge is, ms; null where there is none.
   * @param {string} edge @param {number} now
   */
  age(edge, now) {
    const captured = this.cards.get(edge)?.captured;
    return captured ? now - captured : null;
  }

  /** @param {string} edge @param {string} text */
  event(edge, text) {
    const { last } = this.card(edge);
    last.textContent = last.title = text;
  }

  /** @param {string} edge @param {EdgeState} state @param {number} now */
  state(edge, state, now) {
    const card = this.card(edge);
    card.link = state.link;
    const age = now - card.captured;
    const silent = card.captured > 0 && age > OLD_MS && (state.link === "up" || state.link === "thin");
    card.light.dataset.state = silent ? "silent" : state.link;
    card.state.textContent = words.cardWords(state.link, now - state.since, silent ? age : null);
    const { total, budget } = state;
    const known = total !== null && budget !== null;
    card.bar.hidden = !known;
    card.bar.value = known ? Math.min(1, total / budget) : 0;
    card.bar.title = card.bar.ariaValueText = known ? words.shareWords(total, budget) : "";
  }

  /**
   * About once a second: what is not live looks so, and says how old it is.
   * @param {number} now @param {{has: (edge: string) => boolean}} known the edges of which the ground tells how they are
   */
  refresh(now, known) {
    for (const [edge, card] of this.cards) {
      const age = now - card.captured;
      const old = !known.has(edge) || card.link === "lost" || card.link === "ended" || age > OLD_MS;
      card.button.classList.toggle("old", old);
      card.age.textContent = card.captured && old ? words.oldWords(age) : "";
      if (known.has(edge)) continue;
      card.light.dataset.state = "unknown";
      card.state.textContent = words.UNKNOWN_CARD;
      card.bar.hidden = true;
    }
  }

  /** @param {string} edge */
  leave(edge) {
    const card = this.cards.get(edge);
    if (!card) return;
    URL.revokeObjectURL(card.picture.src);
    card.button.remove();
    this.cards.delete(edge);
    this.nobody.hidden = this.root.children.length > 1;
  }

  /**
   * Edges that other grounds of the group serve, each a way to their page.
   * @param {Record<string, {member: string, page: string}>} edges
   */
  elsewhere(edges) {
    for (const edge of Object.keys(edges)) this.leave(edge); // it was here before
    const now = JSON.stringify(edges);
    if (now === this.others) return;
    this.others = now;
    for (const old of this.root.querySelectorAll(".elsewhere")) old.remove();
    for (const [edge, { member, page }] of Object.entries(edges)) {
      const tile = make(page ? "a" : "span", "elsewhere", this.root);
      if (page) tile.href = `${page}#${new URLSearchParams({ edge })}`;
      make("b", "", tile).textContent = edge;
      make("span", "", tile).textContent = words.elsewhereWords(member);
    }
    this.nobody.hidden = this.root.children.length > 1;
  }

  /** @param {string} chosen empty for none */
  mark(chosen) {
    this.root.classList.toggle("alone", !chosen);
    for (const [edge, { button }] of this.cards) button.setAttribute("aria-current", String(edge === chosen));
    this.cards.get(chosen)?.button.scrollIntoView({ block: "nearest", inline: "nearest" });
  }
}

export const byNumber = new Intl.Collator("en", { numeric: true }).compare; // uav-2, uav-10

/** @param {string} kind @param {string} name @param {Element} into @returns {any} */
export function make(kind, name, into) {
  const made = document.createElement(kind);
  if (name) made.className = name;
  into.append(made);
  return made;
}
