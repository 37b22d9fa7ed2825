// The page: which edge is shown, what its messages go to, and what keys and buttons do.

import { Boxes } from "./boxes.js";
import { Connection, unpacked } from "./connection.js";
import { Player } from "./player.js";
import { Plot } from "./plot.js";
import { Stills, clock } from "./stills.js";
import { Wall, kbps, make } from "./wall.js";

/** @typedef {import("./connection.js").Message} Message */

const GAP_MS = 1000; // without a new picture
/** @type {Record<string, string>} */
const LINK_WORDS = {
  waiting: "waiting for a keyframe",
  up: "link up",
  thin: "link too thin for all frames",
  lost: "link lost",
  ended: "ended",
};
const WAIT_FOR_NAMED_MS = 1500;
const MOST_EVENTS = 200;
const SET_MS = 30000;
const METHODS = ["M0", "M1", "M2", "M3", "M4", "M5", "M6"];
/** @type {Record<string, string>} */
const RUNG_WORDS = {
  hevc: "HEVC, as received",
  h264: "H.264, coded again",
  jpeg: "single pictures, 2 a second",
};

/** @param {string} id @returns {any} */
const by = (id) => document.getElementById(id);

/** @type {Map<string, Message>} */
const sessions = new Map();
/** @type {Map<string, string>} */
const links = new Map();
/** When this page last set something, by edge. @type {Map<string, number>} */
const setAt = new Map();
/** Empty before there is one. */
let chosen = "";
let rungs = Player.rungs();
let role = "viewer";
let shown = { frame: -1, captured: 0, at: 0 };
let tracksAt = 0;

const wall = new Wall(by("wall"), by("nobody"), choose);
const stills = new Stills(by("stills"), by("large"));
const plot = new Plot(by("plot"));
const boxes = new Boxes(by("boxes"), pick);
const player = new Player(by("video"), by("still-picture"), onShown, stepDown);
const connection = new Connection(onMessage, onState);

const wanted = new URLSearchParams(location.hash.slice(1)).get("rung");
if (wanted && rungs.includes(wanted)) rungs = rungs.slice(rungs.indexOf(wanted));
wall.mark("");

/** @param {"connected" | "waiting"} state */
function onState(state) {
  by("connection").textContent = state === "connected" ? "connected" : "no connection to the ground: trying again";
  if (state !== "connected") return;
  connection.send({ type: "wall", shown: true });
  if (chosen) watch();
}

/** @param {Message} message @param {Uint8Array} payload */
function onMessage(message, payload) {
  const mine = message.edge === chosen;
  switch (message.type) {
    case "hello":
      ({ role } = message);
      document.body.className = role;
      by("role").textContent = role;
      stills.reset();
      by("events").replaceChildren();
      break;
    case "session":
      sessions.set(message.edge, message);
      wall.card(message.edge);
      if (mine) describe();
      else if (!chosen) chooseFirst();
      break;
    case "state":
      onGroundState(message);
      break;
    case "loads":
      plot.fill(message.edge, message.rows);
      break;
    case "thumbnail":
      wall.thumbnail(message.edge, payload);
      break;
    case "notice":
      wall.event(message.edge, message.text);
      if (mine) addEvent(message);
      break;
    case "still":
      if (mine) stills.add(/** @type {any} */ (message));
      break;
    case "overlay":
      if (mine) boxes.add(/** @type {any} */ (message));
      break;
    case "start":
      if (mine) {
        player.start(/** @type {any} */ (message));
        boxes.reset();
      }
      break;
    case "init":
      player.init(/** @type {any} */ (message), payload);
      break;
    case "fragment":
      player.fragment(/** @type {any} */ (message), payload);
      break;
    case "jpeg":
      if (mine) player.jpeg(/** @type {any} */ (message), payload);
      break;
  }
}

// Which edge

/** The one that the address names, or after a moment another. */
function chooseFirst() {
  const named = new URLSearchParams(location.hash.slice(1)).get("edge");
  const [first] = [...sessions.keys()].sort();
  if (named && sessions.has(named)) choose(named);
  else if (!named && sessions.size) choose(first);
  else setTimeout(() => chosen || choose(first), WAIT_FOR_NAMED_MS);
}

/** @param {string} edge */
function choose(edge) {
  if (edge === chosen) return;
  chosen = edge;
  history.replaceState(null, "", `#${new URLSearchParams({ edge, ...(wanted ? { rung: wanted } : {}) })}`);
  by("main").hidden = false;
  wall.mark(edge);
  plot.show(edge);
  shown = { frame: -1, captured: 0, at: 0 };
  by("answer").hidden = true;
  by("settings-text").textContent = "";
  describe();
  watch();
}

function watch() {
  player.reset();
  boxes.reset();
  stills.reset();
  by("events").replaceChildren();
  connection.send({ type: "watch", edge: chosen, rung: rungs[0] });
  by("rung").textContent = RUNG_WORDS[rungs[0]];
}

function describe() {
  const session = sessions.get(chosen);
  if (!session) return;
  const [width, height] = session.baseSize;
  by("name").textContent = chosen;
  by("facts").textContent = `${session.method} · ${width}×${height} at ${Math.round(session.fps * 10) / 10} a second · ${kbps(session.budget)}`;
  by("stage").style.aspectRatio = `${width} / ${height}`;
  by("stage").style.maxWidth = `calc(72vh * ${width / height})`;
  boxes.size = session.baseSize;
  showSettings();
}

function stepDown() {
  if (rungs.length < 2) return;
  rungs = rungs.slice(1);
  watch();
}

// The picture

/** @param {{frame: number, captured: number}} picture */
function onShown(picture) {
  shown = { ...picture, at: performance.now() };
  boxes.show(picture);
  const age = by("age");
  const ms = Math.round(connection.now() - picture.captured);
  age.dataset.ms = String(ms);
  age.dataset.frame = String(picture.frame);
  if (!by("gap").hidden) showAge();
  if (performance.now() - tracksAt > 1000) listTracks();
}

function showAge() {
  const lockstep = sessions.get(chosen)?.pace === "lockstep";
  const ms = connection.now() - shown.captured;
  const old = player.live && shown.frame >= 0 && performance.now() - shown.at > GAP_MS;
  by("stage").classList.toggle("old", old);
  by("gap").hidden = !old && shown.frame >= 0;
  by("gap").textContent = shown.frame < 0 ? waitingWords() : `last picture, ${seconds(ms)} old`;
  if (shown.frame < 0) by("age").textContent = "";
  else if (!player.live) by("age").textContent = `of ${clock(shown.captured)}, ${seconds(ms)} ago`;
  else by("age").textContent = lockstep ? "flown in lockstep: no age" : `picture ${seconds(ms)} old`;
  by("now").disabled = player.live;
  by("pause").textContent = by("video").paused && !player.live ? "Play" : "Pause";
}
setInterval(showAge, 200);

const waitingWords = () => (links.get(chosen) === "ended" ? "the flight has ended" : "waiting for a picture");

/** @param {number} ms */
const seconds = (ms) => (Math.abs(ms) < 10000 ? `${(ms / 1000).toFixed(1)} s` : `${Math.round(ms / 1000)} s`);

function listTracks() {
  tracksAt = performance.now();
  const list = by("tracks");
  if (list.contains(document.activeElement)) return; // not under somebody's fingers
  const tracks = boxes.current()?.tracks ?? [];
  by("objects-title").textContent = `Tracks: ${tracks.length}`;
  if (!by("objects").open) return;
  list.replaceChildren();
  for (const track of tracks.slice(0, 40)) {
    const button = make("button", `${track.doubted ? "doubted" : ""} ${track.read ? "read" : ""}`, make("li", "", list));
    button.textContent = `${track.name} ${track.id}`;
    button.setAttribute("aria-label", `${track.name}, track ${track.id}${track.doubted ? ", doubted" : ""}: closer look`);
    button.disabled = role !== "operator";
    button.addEventListener("click", () => pick(track.box, track));
  }
}

// What is asked of the edge

/** @param {number[]} box @param {{name: string, id: number} | null} track */
async function pick(box, track) {
  if (role !== "operator" || !chosen) return;
  const edge = chosen;
  boxes.mark(box);
  tell(`asking ${edge} for ${track ? `${track.name} ${track.id}` : "this place"}`, null);
  const reply = await post(`/edges/${encodeURIComponent(edge)}/still`, { box, frame: shown.frame < 0 ? null : shown.frame });
  boxes.mark(null);
  if (edge !== chosen) return;
  if (typeof reply === "string") {
    tell(reply, null);
    return;
  }
  const [about, data] = unpacked(await reply.arrayBuffer());
  tell(`${track ? `${track.name} ${track.id}` : "this place"}, ${about.place[2]}×${about.place[3]} pixels of the camera`, data);
}

/** @param {string} words @param {Uint8Array | null} picture */
function tell(words, picture) {
  const image = by("answer-picture");
  if (image.src) URL.revokeObjectURL(image.src);
  image.hidden = !picture;
  image.removeAttribute("src");
  if (picture) image.src = URL.createObjectURL(new Blob([picture], { type: "image/jpeg" }));
  image.alt = words;
  by("answer-text").textContent = words;
  by("answer").hidden = false;
}

/** @param {string} address @param {object} content @returns {Promise<Response | string>} the answer, or why there is none */
async function post(address, content) {
  try {
    const reply = await fetch(address, {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(content),
    });
    return reply.ok ? reply : (await reply.text()) || `the ground refused (${reply.status})`;
  } catch {
    return "no connection to the ground";
  }
}

async function keyframe() {
  if (role !== "operator" || !chosen) return;
  const reply = await post(`/edges/${encodeURIComponent(chosen)}/keyframe`, {});
  if (typeof reply === "string") tell(reply, null);
}

/** @param {object} content @param {object} now of the session, once it is set @param {string} words */
async function set(content, now, words) {
  if (role !== "operator" || !chosen) return;
  const edge = chosen;
  by("settings-text").textContent = "asking the edge";
  const reply = await post(`/edges/${encodeURIComponent(edge)}/settings`, content);
  if (typeof reply !== "string") {
    Object.assign(sessions.get(edge) ?? {}, now);
    setAt.set(edge, performance.now());
  }
  if (edge !== chosen) return;
  by("settings-text").textContent = typeof reply === "string" ? reply : words;
  describe();
}

/** What the edge flies with now; not under somebody's fingers. */
function showSettings() {
  const session = sessions.get(chosen);
  if (!session || by("settings").contains(document.activeElement)) return;
  by("budget").value = String(Math.round(session.budget / 1000));
  by("method").value = session.method;
}

for (const name of METHODS) make("option", "", by("method")).textContent = name;
by("settings").addEventListener("submit", (/** @type {Event} */ event) => {
  event.preventDefault();
  const kbps = Number(by("budget").value);
  set({ kbps }, { budget: 1000 * kbps }, `${kbps} kbps from now on`);
});
by("method").addEventListener("change", () => {
  const method = by("method").value;
  set({ method }, { method }, `stills by ${method} from now on`);
});

// Link and events

/** @param {Message} message */
function onGroundState(message) {
  wall.elsewhere(message.elsewhere);
  for (const [edge, state] of Object.entries(message.edges)) {
    wall.state(edge, state, message.at);
    links.set(edge, state.link);
    if (state.total !== null) plot.add(edge, { at: message.at, total: state.total, base: state.base, budget: state.budget });
    const session = sessions.get(edge);
    const fresh = performance.now() - (setAt.get(edge) ?? -Infinity) < SET_MS; // the ground learns of it later
    if (session && state.budget !== null && !fresh) Object.assign(session, { budget: state.budget, method: state.method });
    if (edge !== chosen) continue;
    describe();
    const words = [`${LINK_WORDS[state.link]} since ${clock(state.since)}`, ...state.words];
    by("link-text").textContent = words.join(" · ");
    const failed = [...state.failed, ...message.failed];
    by("failed").textContent = failed.join(" · ");
  }
}

/** @param {Message} message */
function addEvent(message) {
  const item = document.createElement("li");
  item.className = message.level;
  const time = make("button", "", item);
  time.textContent = clock(message.at * 1000);
  time.setAttribute("aria-label", `the picture of ${clock(message.at * 1000)}`);
  time.addEventListener("click", () => {
    if (player.show(message.captured)) showAge();
    else {
      time.disabled = true;
      time.title = "no longer at hand: see the recording";
    }
  });
  make("span", "", item).textContent = message.text;
  by("events").prepend(item);
  while (by("events").children.length > MOST_EVENTS) by("events").lastElementChild.remove();
}

// Keys and buttons

/** @type {Record<string, () => void>} */
const actions = {
  pause: () => {
    if (player.live) player.pause();
    else if (by("video").paused) player.play();
    else by("video").pause();
    showAge();
  },
  back: () => player.step(-5),
  forward: () => player.step(5),
  now: () => player.goLive(),
  keyframe,
};
for (const [id, act] of Object.entries(actions)) by(id).addEventListener("click", act);
by("answer-close").addEventListener("click", () => {
  by("answer").hidden = true;
});
addEventListener("keydown", (event) => {
  if (/** @type {Element} */ (event.target).closest("button, input, select") || by("large").open || event.ctrlKey || event.metaKey || event.altKey) return;
  const act = { " ": "pause", ArrowLeft: "back", ArrowRight: "forward", l: "now", k: "keyframe" }[event.key];
  if (!act) return;
  event.preventDefault();
  actions[act]();
});
