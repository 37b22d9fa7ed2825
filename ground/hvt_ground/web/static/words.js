// What the page says of the picture, in one place: pure functions of what is known. What is not known is not said.

/**
 * @typedef {{connected: boolean, refused: boolean, goneMs: number, link: string, silentMs: number | null, chosen: boolean,
 *    shown: boolean, follows: boolean, plays: boolean, ageMs: number, sinceMs: number, periodMs: number,
 *    lastMs: number | null, lockstep: boolean}} Facts
 * Whether the ground answers or refuses this page, and since when not; the link and for how long nothing has come;
 * whether a picture is shown, follows the newest, plays on; its age, when it was shown, what usually lies between two; the age of the newest
 * one of this edge, wherever it is shown.
 */

/** @type {Record<string, string>} */
export const LINK_WORDS = {
  waiting: "waiting for a keyframe",
  up: "link up",
  thin: "the link does not carry all frames",
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

/** @param {number} ms */
export const seconds = (ms) => (Math.abs(ms) < 9950 ? `${(ms / 1000).toFixed(1)} s` : `${Math.round(ms / 1000)} s`);

/** @param {number} ms */
const whole = (ms) => `${Math.max(0, Math.round(ms / 1000))} s`;

/**
 * By clocks that agree within the time of a message; of a picture of the future it is not known.
 * @param {number} ms
 */
const age = (ms) => (ms < -LEAST_GAP_MS ? "age not known" : seconds(Math.max(0, ms)));

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
  const patience = Math.min(MOST_GAP_MS, Math.max(LEAST_GAP_MS, 2.5 * facts.periodMs));
  if (sinceMs > patience) return { state: "stale", words: `NO NEW PICTURE ${whole(sinceMs)}`, live: false };
  return { state: "live", words: facts.lockstep ? "lockstep: no age" : `live, ${age(ageMs)}`, live: true };
}

/**
 * How old the list of boxes is that belongs to this picture; null where none has come.
 * @param {number | null} behindMs @param {number} oldMs beyond, no box is drawn
 */
export function boxesWords(behindMs, oldMs) {
  if (behindMs === null) return "no boxes yet";
  return behindMs > oldMs ? `boxes ${seconds(behindMs)} behind` : "";
}

/** @param {number | null} count of tracks; null where it is not known @param {string} behind */
export function tracksTitle(count, behind) {
  if (count === null) return "Tracks: not known yet";
  return behind ? `Tracks: ${count} (${behind})` : `Tracks: ${count}`;
}

/** @param {boolean | null} recording null: not known */
export const recordingWords = (recording) => (recording === null ? "" : recording ? "recording" : "NOT RECORDED");

/** @param {boolean} connected @param {string} why the ground's own words, where it refuses */
export function connectionWords(connected, why) {
  if (connected) return "connected";
  return why ? `the ground refuses this page: ${why}` : "no connection to the ground: trying again";
}
