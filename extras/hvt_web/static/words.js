// All that the page says, in one place: pure functions of what is known. What is not known is not said.

/**
 * @typedef {{connected: boolean, refused: boolean, goneMs: number, link: string, silentMs: number | null, chosen: boolean,
 *    shown: boolean, follows: boolean, plays: boolean, ageMs: number, sinceMs: number, periodsMs: number[],
 *    lastMs: number | null, lockstep: boolean}} Facts
 * Whether the ground answers or refuses this page, and since when not; the link and for how long nothing has come;
 * whether a picture is shown, follows the newest, plays on; its age, when it was shown, what lay between the last ones; the age of the newest
 * one of this edge, wherever it is shown.
 */
/** @typedef {{track: number | null, before: string, after: string, sureness: number, reason: string, why: string,
 *    stored: boolean, unread: boolean, doubted: boolean, note: string, earlier?: boolean}} StillFacts */
/** @typedef {{name: string, id: number, sureness: number, doubted?: 1}} TrackFacts */

/** @type {Record<string, string>} */
export const LINK_WORDS = {
  waiting: "waiting for a keyframe",
  up: "link up",
  thin: "link or machine too slow for all frames",
  lost: "link lost",
  ended: "ended",
};
/** @type {Record<string, string>} */
export const RUNG_WORDS = {
  hevc: "HEVC, as received",
  h264: "H.264, coded again",
  jpeg: "single pictures, 2 a second",
};
const LEAST_GAP_MS = 1000;
const MOST_GAP_MS = 12000;
const LATE_MS = 2000;

// Numbers

/**
 * Of a time that has gone by: where two clocks differ a little, it is none.
 * @param {number} ms
 */
export const seconds = (ms) => (ms < 9950 ? `${Math.max(0, ms / 1000).toFixed(1)} s` : whole(ms));

/** @param {number} ms */
const whole = (ms) => `${Math.max(0, Math.round(ms / 1000))} s`;

/** @param {number} ms */
function lasting(ms) {
  const seconds = Math.max(0, Math.round(ms / 1000));
  if (seconds < 100) return `${seconds} s`;
  return seconds < 6000 ? `${Math.round(seconds / 60)} min` : `${Math.round(seconds / 3600)} h`;
}

/** @param {number} bps */
export const kbps = (bps) => (bps >= 1e6 ? `${(bps / 1e6).toFixed(2)} Mbps` : `${Math.round(bps / 1e3)} kbps`);

/** @param {number} ms */
export const clock = (ms) => new Date(ms).toLocaleTimeString([], { hourCycle: "h23" });

/** @param {number} share */
const percent = (share) => `${Math.round(share * 100)} %`;

/**
 * By clocks that agree within the time of a message; of a picture of the future it is not known.
 * @param {number} ms
 */
const age = (ms) => (ms < -LEAST_GAP_MS ? "age not known" : seconds(ms));

// On the picture

/**
 * The state of the picture: its name for the style, the words that stand on it, whether it is the picture of now.
 * @param {Facts} facts @returns {{state: string, words: string, live: boolean}}
 */
export function standing(facts) {
  const { shown, ageMs, sinceMs } = facts;
  if (!facts.connected) return { state: "gone", words: `${facts.refused ? "REFUSED" : "NO GROUND"} ${whole(facts.goneMs)}`, live: false };
  if (facts.link === "ended") return { state: "ended", words: shown ? `ENDED, picture ${seconds(ageMs)} old` : "ENDED", live: false };
  if (facts.link === "lost") return { state: "lost", words: `LINK LOST ${whole(facts.silentMs ?? sinceMs)}`, live: false };
  if (!shown && (facts.lastMs ?? 0) > MOST_GAP_MS) return { state: "stale", words: `NO PICTURE ${whole(facts.lastMs ?? 0)}`, live: false };
  if (!shown) return { state: "waiting", words: "waiting for a picture", live: false };
  if (!facts.follows) {
    return { state: "paused", words: `${facts.plays ? "REPLAY" : "PAUSED"} ${seconds(ageMs)}`, live: false };
  }
  // By the middle one: a hiccup before the camera went would leave its last picture bright for as long.
  const period = [...facts.periodsMs].sort((one, other) => one - other)[facts.periodsMs.length >> 1] ?? 0;
  const patience = Math.min(MOST_GAP_MS, Math.max(LEAST_GAP_MS, 2.5 * period));
  // Who comes later is shown a picture that may be old already.
  if (sinceMs > patience || ageMs > MOST_GAP_MS) return { state: "stale", words: `NO NEW PICTURE ${whole(Math.max(sinceMs, ageMs))}`, live: false };
  if (facts.lockstep) return { state: "live", words: "lockstep: no age", live: true };
  // The picture moves, and is not that of now.
  if (ageMs > LATE_MS) return { state: "late", words: `LATE, ${seconds(ageMs)} old`, live: true };
  return { state: "live", words: `live, ${age(ageMs)}`, live: true };
}

/**
 * To who listens, when it changes: without the times, which are others each moment.
 * @param {string} said of the picture @param {string[]} failed
 */
export const spokenWords = (said, failed) => [said, ...failed].join(". ").replace(/,?( picture| for| by)? \d[\d.]* (s|min|h)( old)?(?=\.|$)/g, "");

/**
 * In the middle of an empty picture, by the state.
 * @param {string} state
 */
export const emptyWords = (state) =>
  state === "ended" ? "the flight has ended" : state === "stale" ? "no picture comes" : "waiting for a picture";

/**
 * How old the look is that the boxes of this picture rest on; null where none has come.
 * @param {number | null} behindMs @param {number} oldMs beyond, it is said
 */
export function boxesWords(behindMs, oldMs) {
  if (behindMs === null) return "no boxes yet";
  return behindMs > oldMs ? `boxes ${seconds(behindMs)} behind` : "";
}

/**
 * Of a picture that is not the newest.
 * @param {number} captured @param {number} ageMs
 */
export const pictureWords = (captured, ageMs) => `of ${clock(captured)}, ${seconds(ageMs)} ago`;

/** @param {boolean} plays */
export const pauseWords = (plays) => (plays ? "Pause" : "Play");

/**
 * @param {boolean | null} recording null: not known
 * @param {boolean} comes whether there is anything to record
 */
export const recordingWords = (recording, comes) => (recording === false ? "NOT RECORDED" : recording && comes ? "recording" : "");

/** @param {string} name @param {number} sureness @param {boolean} sure */
export const boxWords = (name, sureness, sure) => `${name} ${sure ? "✓" : Math.round(sureness * 100)}`;

// Around it

/** @param {boolean} connected @param {string} why the ground's own words, where it refuses */
export function connectionWords(connected, why) {
  if (connected) return "connected";
  return why ? `the ground refuses this page: ${why}` : "no connection to the ground: trying again";
}

/** @param {string} edge */
export const absentWords = (edge) => `${edge}, which the address names, is not here: it is shown when it comes; or choose another`;

/** @param {string} method @param {number[]} size @param {number} fps @param {number} budget */
export const sessionWords = (method, [width, height], fps, budget) =>
  `${method} · ${width}×${height} at ${Math.round(fps * 10) / 10} a second · ${kbps(budget)}`;

/** @param {string} link @param {number} since @param {string[]} more the ground's own sentences */
export const linkWords = (link, since, more) => [`${LINK_WORDS[link]} since ${clock(since)}`, ...more].join(" · ");

export const UNKNOWN_LINK = "not known: the ground says nothing now";

/**
 * On the plot, by line.
 * @param {number} budget
 */
export const plotWords = (budget) => ({ total: "all", base: "base stream", budget: `budget ${kbps(budget)}` });

/** @param {number} minutes */
export const minutesAgo = (minutes) => `−${minutes} min`;

/**
 * Of an event.
 * @param {number} captured
 */
export const eventPictureWords = (captured) => `the picture of ${clock(captured)}`;

export const PICTURE_GONE = "no longer at hand: see the recording";

// The wall

/** @param {string} link @param {number} ms since when @param {number | null} silentMs of an edge that should send pictures and does not */
export const cardWords = (link, ms, silentMs) => (silentMs === null ? `${link} ${lasting(ms)}` : `no picture ${lasting(silentMs)}`);

export const UNKNOWN_CARD = "not known";
export const BUDGET_SHARE = "Share of the budget in use";

/** @param {number} total @param {number} budget */
export const shareWords = (total, budget) => `${kbps(total)} of ${kbps(budget)}`;

/** @param {number} ms */
export const oldWords = (ms) => `${lasting(ms)} old`;

/** @param {string} member another ground */
export const elsewhereWords = (member) => `at ${member}`;

// Tracks and stills

/** @param {number | null} count of tracks; null where it is not known @param {string} behind */
export function tracksTitle(count, behind) {
  if (count === null) return "Tracks: not known yet";
  return behind ? `Tracks: ${count} (${behind})` : `Tracks: ${count}`;
}

export const OF_LAST_PICTURE = "of the last picture";

/** @param {TrackFacts} track */
export const trackWords = (track) => `${track.name} ${track.id}, ${percent(track.sureness)}`;

/** @param {TrackFacts} track */
export const trackLabel = (track) => `${track.name}, track ${track.id}${track.doubted ? ", doubted" : ""}: closer look`;

/** @param {StillFacts} still */
export function stillWords(still) {
  if (still.track === null && still.reason === "asked") return "a closer look"; // of a place, whatever is there
  const track = still.track === null ? "" : `track ${still.track}${still.earlier ? " of the flight before" : ""}: `;
  if (still.unread) return `${track}${still.after}, not read${still.note ? ` (${still.note})` : ""}`;
  const sure = percent(still.sureness);
  if (still.doubted) return `${track}doubted, ${still.before === still.after ? `${still.after} at ${sure}` : `was ${still.before}`}`;
  return still.before === still.after || !still.before ? `${track}${still.after}, ${sure}` : `${track}${still.before} → ${still.after}, ${sure}`;
}

/** @param {StillFacts & {captured: number}} still */
export const stillReason = (still) => `${clock(still.captured)} · ${still.why}${still.stored ? " · came afterwards" : ""}`;

/** @param {StillFacts & {captured: number}} still */
export const stillTitle = (still) => `${stillWords(still)} · ${stillReason(still)}`;

/** @param {StillFacts} still */
export const stillAlt = (still) => `still: ${stillWords(still)}`;

export const BASE_ALT = "what the base stream showed";

// Commands, and what came of them

/** @param {TrackFacts | null} track */
const place = (track) => (track ? `${track.name} ${track.id}` : "this place");

/** @param {string} edge @param {TrackFacts | null} track */
export const askingStill = (edge, track) => `asking ${edge} for ${place(track)}`;

/**
 * @param {TrackFacts | null} track @param {number[]} box x, y, width and height in the camera's picture
 * @param {number | null} captured null: not known
 */
export const answeredStill = (track, [, , width, height], captured) =>
  `${place(track)}${captured === null ? "" : ` at ${clock(captured)}`}, ${width}×${height} pixels of the camera`;

/** @param {number} status */
export const refusedWords = (status) => `the ground refused (${status})`;

export const NO_CONNECTION = "no connection to the ground";

export const ASKING_KEYFRAME = "asked for a keyframe";
export const KEYFRAME_TAKEN = "the edge has taken the request for a keyframe";

/** @param {number} ms */
export const keyframeCame = (ms) => `a keyframe came ${seconds(ms)} after it was asked for`;

/** @param {number} ms */
export const noKeyframe = (ms) => `no keyframe has come within ${seconds(ms)}`;

/** @param {{budget?: number, method?: string}} what */
const setting = ({ budget, method }) => (budget ? kbps(budget) : `stills by ${method}`);

/** @param {string} edge @param {{budget?: number, method?: string}} what */
export const askingSetting = (edge, what) => `asking ${edge} for ${setting(what)}`;

/** @param {string} edge @param {{budget?: number, method?: string}} what */
export const agreedSetting = (edge, what) => `${edge} has agreed to ${setting(what)}; it is not in force yet`;

/** @param {{budget?: number, method?: string}} what */
export const settingInForce = (what) => `${setting(what)} ${what.budget ? "is" : "are"} in force`;
