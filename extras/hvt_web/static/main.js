// The page: which edge is shown, what its messages go to, and what keys and buttons do.

import { Boxes, OLD_MS } from "./boxes.js";
import { Connection, unpacked } from "./connection.js";
import { Player } from "./player.js";
import { Plot } from "./plot.js";
import { Stills } from "./stills.js";
import { Wall, byNumber, make } from "./wall.js";
import * as words from "./words.js";

/** @typedef {import("./connection.js").Message} Message */

const STATE_OLD_MS = 4000; // one comes each second
const PERIODS = 8; // between pictures
const KEYFRAME_MS = 8000;
const MOST_EVENTS = 200;
const METHODS = ["M0", "M1", "M2", "M3", "M4", "M5", "M6"];

/** @param {string} id @returns {any} */
const by = (id) => document.getElementById(id);

/** @type {Map<string, Message>} */
const sessions = new Map();
/**
 * How each edge is, by the newest state; empty where that is old.
 * @type {Map<string, Message>}
 */
const states = new Map();
/** When a keyframe of the chosen edge was asked for; 0: none is waited for. */
let keyframeAt = 0;
/**
 * A budget or method that is asked for and not confirmed, by edge.
 * @type {Map<string, {budget?: number, method?: string}>}
 */
const asked = new Map();
/**
 * Between the pictures that were shown last, ms.
 * @type {number[]}
 */
let periods = [];
let connected = false;
let refused = false;
let connectedAt = performance.now();
let stateAt = -Infinity;
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

/** @param {"connected" | "waiting"} state @param {string} why */
function onState(state, why) {
  connected = state === "connected";
  refused = Boolean(why);
  if (connected) connectedAt = performance.now();
  showAge();
  by("connection").textContent = words.connectionWords(connected, why);
  by("connection").classList.toggle("bad", !connected);
  if (connected && chosen) watch();
  connection.send({ type: "wall", shown: true });
}

/** @param {Message} message @param {Uint8Array} payload */
function onMessage(message, payload) {
  const mine = message.edge === chosen;
  switch (message.type) {
    case "hello":
      ({ role } = message);
      document.body.className = role;
      by("commands").hidden = role !== "operator";
      by("role").textContent = role;
      forgetEvents();
      break;
    case "session":
      if (sessions.get(message.edge)?.session !== message.session) {
        wall.event(message.edge, ""); // it begins anew
        asked.delete(message.edge);
        if (mine) forget(); // with other frames
      }
      sessions.set(message.edge, message);
      if (mine) describe();
      else if (!chosen) chooseFirst();
      break;
    case "gone":
      leave(message.edge);
      break;
    case "state":
      onGroundState(message);
      break;
    case "loads":
      plot.fill(message.edge, message.rows);
      if (mine) forgetEvents(); // all that there are follow
      break;
    case "thumbnail":
      wall.thumbnail(message.edge, payload, Math.min(message.captured, connection.now())); // none is of the future
      break;
    case "notice":
      wall.event(message.edge, message.text);
      if (mine) addEvent(message);
      break;
    case "still":
      if (mine) stills.add(/** @type {any} */ ({ ...message, earlier: !message.id.startsWith(sessions.get(chosen)?.session.slice(2)) }));
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
      if (mine && message.key && keyframeAt) {
        confirm(words.keyframeCame(performance.now() - keyframeAt));
        keyframeAt = 0;
      }
      break;
    case "jpeg":
      if (mine) player.jpeg(/** @type {any} */ (message), payload);
      break;
  }
}

// Which edge

/** @param {string} edge that the ground has forgotten */
function leave(edge) {
  for (const known of [sessions, states, asked, plot.rows]) known.delete(edge);
  wall.leave(edge);
  if (edge !== chosen) return;
  chosen = "";
  by("main").hidden = true;
  wall.mark("");
  chooseFirst(); // it, where it comes again
}

/** The one that the address names; where it names none, the first. */
function chooseFirst() {
  const named = new URLSearchParams(location.hash.slice(1)).get("edge");
  const [first] = [...sessions.keys()].sort(byNumber);
  if (named && !sessions.has(named)) {
    by("absent").textContent = words.absentWords(named);
    by("absent").hidden = false;
  } else if (sessions.size) choose(named || first);
}

/** @param {string} edge */
function choose(edge) {
  if (edge === chosen) return;
  chosen = edge;
  history.replaceState(null, "", `#${new URLSearchParams({ edge, ...(wanted ? { rung: wanted } : {}) })}`);
  by("main").hidden = false;
  by("absent").hidden = true;
  wall.mark(edge);
  plot.show(edge);
  by("answer").hidden = true;
  forget();
  by("link-text").textContent = by("failed").textContent = "";
  by("why-list").replaceChildren();
  describe();
  watch();
  const state = states.get(edge);
  if (state) showState(state);
}

/** No pixel, box or number of what was shown before may stand under this name. */
function forget() {
  player.clear();
  boxes.reset();
  by("settings-text").textContent = "";
  keyframeAt = 0;
  shown = { frame: -1, captured: 0, at: 0 };
  periods = [];
  by("tracks").replaceChildren();
  by("classes").replaceChildren();
  boxes.left.clear();
  stills.outdate();
  showAge();
  listTracks();
}

function forgetEvents() {
  stills.reset();
  by("events").replaceChildren();
}

function watch() {
  player.reset(); // the last picture stays, with its boxes
  forgetEvents();
  connection.send({ type: "watch", edge: chosen, rung: rungs[0] });
  by("rung").textContent = words.RUNG_WORDS[rungs[0]];
}

function describe() {
  const session = sessions.get(chosen);
  if (!session) return;
  const { method, baseSize, fps, budget } = session;
  const [width, height] = baseSize;
  by("name").textContent = chosen;
  by("facts").textContent = words.sessionWords(method, baseSize, fps, budget);
  by("stage").style.aspectRatio = `${width} / ${height}`;
  by("stage").style.maxWidth = `calc(min(72vh, max(15rem, 100vh - 24.5rem)) * ${width / height})`;
  boxes.size = baseSize;
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
  if (picture.frame > shown.frame && shown.frame >= 0) periods = [...periods.slice(1 - PERIODS), picture.captured - shown.captured];
  shown = { ...picture, at: performance.now() };
  boxes.show(picture);
  const age = by("age");
  const ms = Math.round(connection.now() - picture.captured);
  age.dataset.ms = String(ms);
  age.dataset.frame = String(picture.frame);
  if (by("stage").classList.contains("old")) showAge();
  showBehind();
  if (performance.now() - tracksAt > 1000) listTracks();
}

function showAge() {
  const now = performance.now();
  const ms = connection.now() - shown.captured;
  const state = states.get(chosen);
  const jpeg = rungs[0] === "jpeg";
  const { state: name, words: said, live } = words.standing({
    connected: connected && (now - stateAt < STATE_OLD_MS || now - connectedAt < STATE_OLD_MS),
    refused,
    goneMs: now - Math.max(stateAt, 0),
    link: state?.link ?? "",
    silentMs: state ? connection.now() - state.since : null,
    chosen: Boolean(chosen),
    shown: shown.frame >= 0,
    follows: player.live,
    plays: !by("video").paused && !jpeg,
    ageMs: ms,
    sinceMs: now - shown.at,
    periodsMs: periods.length ? periods : [1000 / (sessions.get(chosen)?.fps ?? 10)],
    lastMs: wall.age(chosen, connection.now()),
    lockstep: sessions.get(chosen)?.pace === "lockstep",
  });
  const stage = by("stage");
  stage.dataset.state = name;
  stage.classList.toggle("old", !live && shown.frame >= 0 && name !== "paused");
  by("standing").textContent = said;
  const spoken = words.spokenWords(said, state?.failed ?? []);
  if (by("spoken").textContent !== spoken) by("spoken").textContent = spoken;
  const gone = name === "gone";
  showBehind();
  by("on-link").textContent = state && !gone && name !== "lost" ? state.short : "";
  by("recording").textContent = gone ? "" : words.recordingWords(state?.recording ?? null, !["lost", "stale", "ended"].includes(name));
  by("recording").classList.toggle("bad", state?.recording === false);
  by("gap").hidden = shown.frame >= 0;
  by("gap").textContent = words.emptyWords(name);
  by("age").textContent = shown.frame < 0 || player.live ? "" : words.pictureWords(shown.captured, ms);
  by("now").disabled = player.live;
  by("back").disabled = by("forward").disabled = jpeg; // none of those is kept
  by("pause").textContent = words.pauseWords(!by("video").paused || player.live);
}
setInterval(showAge, 200);

/** With each picture: boxes that stand beside their objects are never without a word. */
function showBehind() {
  const unknown = shown.frame < 0 || by("stage").dataset.state === "gone";
  by("behind").textContent = unknown ? "" : words.boxesWords(boxes.behind(), OLD_MS);
}

setInterval(() => {
  if (!connected || performance.now() - stateAt >= STATE_OLD_MS) states.clear();
  wall.refresh(connection.now(), states);
  if (performance.now() - tracksAt > 1000) listTracks();
  by("commands").disabled = (states.get(chosen)?.link ?? "ended") === "ended";
  if (states.has(chosen)) return;
  plot.tick(connection.now());
  if (by("link-text").textContent) by("link-text").textContent = words.UNKNOWN_LINK;
  by("failed").textContent = "";
  by("why-list").replaceChildren();
}, 500);

function listTracks() {
  tracksAt = performance.now();
  const list = by("tracks");
  if (list.contains(document.activeElement)) return; // not under somebody's fingers
  const newest = boxes.newest();
  const tracks = newest?.tracks ?? [];
  const old = by("stage").classList.contains("old") ? words.OF_LAST_PICTURE : words.boxesWords(boxes.behind(), OLD_MS);
  by("objects-title").textContent = words.tracksTitle(newest ? tracks.length : null, old);
  listClasses(tracks);
  if (!by("objects").open) return;
  list.replaceChildren();
  for (const track of tracks.slice(0, 40)) {
    const button = make("button", `${track.doubted ? "doubted" : ""} ${track.read ? "read" : ""}`, make("li", "", list));
    button.textContent = words.trackWords(track);
    button.setAttribute("aria-label", words.trackLabel(track));
    button.disabled = role !== "operator";
    button.addEventListener("click", () => pick(track.box, track));
  }
}

/**
 * A button for each class that was there, in its colour.
 * @param {{name: string, doubted?: 1}[]} tracks
 */
function listClasses(tracks) {
  const known = new Set([...by("classes").children].map((one) => one.dataset.name));
  for (const track of tracks) {
    const { name } = track;
    if (known.has(name) || known.size >= 24) continue;
    known.add(name);
    const button = make("button", "", by("classes"));
    button.dataset.name = button.textContent = name;
    button.style.borderColor = boxes.colourOf(name);
    button.setAttribute("aria-pressed", "true");
    button.addEventListener("click", () => boxes.filter(name, pressed(button)));
  }
}

/**
 * Press a button that stays pressed, or let it go.
 * @param {Element} button
 * @returns {boolean} whether it is pressed now
 */
function pressed(button) {
  const now = button.getAttribute("aria-pressed") !== "true";
  button.setAttribute("aria-pressed", String(now));
  return now;
}

// What is asked of the edge

/** @param {string} said what came of a command */
const confirm = (said) => (by("settings-text").textContent = said);

/** @param {number[]} box @param {words.TrackFacts | null} track */
async function pick(box, track) {
  if (role !== "operator" || !chosen) return;
  const edge = chosen;
  boxes.mark(box);
  tell(words.askingStill(edge, track), null);
  const reply = await post(`edges/${encodeURIComponent(edge)}/still`, { box, frame: shown.frame < 0 ? null : shown.frame });
  boxes.mark(null);
  if (edge !== chosen) return;
  if (typeof reply === "string") {
    tell(reply, null);
    return;
  }
  const [about, data] = unpacked(await reply.arrayBuffer());
  tell(words.answeredStill(track, about.place, boxes.newest(about.frame)?.captured ?? null), data);
}

/** @param {string} said @param {Uint8Array | null} picture */
function tell(said, picture) {
  const image = by("answer-picture");
  if (image.src) URL.revokeObjectURL(image.src);
  image.hidden = !picture;
  image.removeAttribute("src");
  if (picture) image.src = URL.createObjectURL(new Blob([picture], { type: "image/jpeg" }));
  image.alt = by("answer-text").textContent = said;
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
    return reply.ok ? reply : (await reply.text()) || words.refusedWords(reply.status);
  } catch {
    return words.NO_CONNECTION;
  }
}

async function keyframe() {
  if (role !== "operator" || !chosen) return;
  const edge = chosen;
  const at = performance.now();
  keyframeAt = rungs[0] === "jpeg" ? 0 : at;
  confirm(words.ASKING_KEYFRAME);
  const reply = await post(`edges/${encodeURIComponent(edge)}/keyframe`, {});
  if (edge !== chosen) return;
  if (typeof reply === "string") {
    keyframeAt = 0;
    confirm(reply);
  } else if (rungs[0] === "jpeg") confirm(words.KEYFRAME_TAKEN);
  setTimeout(() => {
    if (keyframeAt !== at) return;
    keyframeAt = 0;
    confirm(words.noKeyframe(KEYFRAME_MS));
  }, KEYFRAME_MS);
}

/** @param {object} content @param {{budget?: number, method?: string}} now of the session, once it is set */
async function set(content, now) {
  if (role !== "operator" || !chosen) return;
  const edge = chosen;
  confirm(words.askingSetting(edge, now));
  const reply = await post(`edges/${encodeURIComponent(edge)}/settings`, content);
  if (typeof reply !== "string") asked.set(edge, now);
  if (edge !== chosen) return;
  confirm(typeof reply === "string" ? reply : words.agreedSetting(edge, now));
  describe();
}

/**
 * The edge says what it flies with: what was asked for is in force.
 * @param {string} edge
 * @param {Message} state
 */
function confirmSet(edge, state) {
  const now = asked.get(edge);
  if (!now || state.budget === null) return;
  const before = sessions.get(edge) ?? state;
  const names = /** @type {("budget" | "method")[]} */ (Object.keys(now));
  const came = names.every((name) => state[name] === now[name]);
  if (came || names.some((name) => state[name] !== before[name])) asked.delete(edge); // or somebody set another
  if (came && edge === chosen) confirm(words.settingInForce(now));
}

/** What the edge flies with now, or has agreed to; not under somebody's fingers. */
function showSettings() {
  const session = sessions.get(chosen);
  if (!session || by("commands").contains(document.activeElement)) return;
  const now = asked.get(chosen);
  by("budget").value = String(Math.round((now?.budget ?? session.budget) / 1000));
  by("method").value = now?.method ?? session.method;
}

for (const name of METHODS) make("option", "", by("method")).textContent = name;
by("budget-form").addEventListener("submit", (/** @type {Event} */ event) => {
  event.preventDefault();
  const kbps = Number(by("budget").value);
  set({ kbps }, { budget: 1000 * kbps });
});
// A wheel or a key that moves a list commands nothing: only Set does.
by("method-form").addEventListener("submit", (/** @type {Event} */ event) => {
  event.preventDefault();
  const method = by("method").value;
  set({ method }, { method });
});
by("show-boxes").addEventListener("click", () => boxes.toggle(pressed(by("show-boxes"))));

// Link and events

/** @param {Message} message */
function onGroundState(message) {
  stateAt = performance.now();
  states.clear(); // an edge that is not in it may have ended while the ground was away
  wall.elsewhere(message.elsewhere);
  for (const [edge, state] of Object.entries(message.edges)) {
    wall.state(edge, state, message.at);
    states.set(edge, { ...state, failed: [...state.failed, ...message.failed] });
    if (state.total !== null) plot.add(edge, { at: message.at, total: state.total, base: state.base, budget: state.budget });
    const session = sessions.get(edge);
    confirmSet(edge, state);
    if (session && state.budget !== null) Object.assign(session, { budget: state.budget, method: state.method });
    if (edge !== chosen) continue;
    describe();
    showState(/** @type {Message} */ (states.get(edge)));
  }
  plot.tick(message.at);
}

/**
 * How the chosen edge is.
 * @param {Message} state
 */
function showState(state) {
  by("link-text").textContent = words.linkWords(state.link, state.since, state.words);
  by("failed").textContent = state.failed.join(" · ");
  by("why-list").replaceChildren();
  for (const one of state.why) make("li", "", by("why-list")).textContent = one;
}

/** @param {Message} message */
function addEvent(message) {
  const item = document.createElement("li");
  item.className = message.level;
  const time = make("button", "", item);
  time.textContent = words.clock(message.at * 1000);
  time.setAttribute("aria-label", words.eventPictureWords(message.at * 1000));
  time.addEventListener("click", () => {
    if (player.show(message.captured)) showAge();
    else {
      time.disabled = true;
      time.title = words.PICTURE_GONE;
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
by("answer-close").addEventListener("click", () => (by("answer").hidden = true));
addEventListener("keydown", (event) => {
  if (/** @type {Element} */ (event.target).closest("button, input, select, summary") || by("large").open || event.ctrlKey || event.metaKey || event.altKey) return;
  const act = { " ": "pause", ArrowLeft: "back", ArrowRight: "forward", l: "now", k: "keyframe", L: "now", K: "keyframe" }[event.key];
  if (!act) return;
  event.preventDefault();
  actions[act]();
});
addEventListener("hashchange", () => location.reload()); // the address names an edge or a rung anew
