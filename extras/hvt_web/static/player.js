// Plays the live picture: fragments by Media Source, or single JPEGs. Knows which frame is on the screen.

/** @typedef {{media: number, frame: number, captured: number}} Picture */

const KEPT_S = 125; // for steps back
const BEHIND_S = 0.8; // beyond, it jumps
const HURRY_FRAMES = 2.5;
const MOST_WAITING = 600;
// Safari on a phone has only the former.
const MANAGED = "ManagedMediaSource" in window;
/** @type {typeof MediaSource} */
const Source = /** @type {any} */ (window).ManagedMediaSource ?? window.MediaSource;

export class Player {
  /**
   * @param {HTMLVideoElement} video
   * @param {HTMLImageElement} image
   * @param {(picture: Picture) => void} onShown
   * @param {() => void} onFailed the browser cannot play this
   */
  constructor(video, image, onShown, onFailed) {
    this.video = video;
    this.image = image;
    this.onShown = onShown;
    this.onFailed = onFailed;
    /** Whether it shows the newest picture, and not one that was stepped back to. */
    this.live = true;
    this.stream = -1;
    this.duration = 0.1;
    /** @type {Picture[]} */
    this.pictures = [];
    /** @type {Uint8Array[]} */
    this.waiting = [];
    /** @type {SourceBuffer | null} */
    this.buffer = null;
    video.addEventListener("error", () => {
      if (this.stream >= 0 && video.src) this.onFailed();
    });
    const shown = (/** @type {number} */ _now, /** @type {{mediaTime: number}} */ about) => {
      const picture = this.at(about.mediaTime);
      if (picture) this.onShown(picture);
      video.requestVideoFrameCallback(shown);
    };
    if ("requestVideoFrameCallback" in video) video.requestVideoFrameCallback(shown);
    else {
      video.addEventListener("timeupdate", () => {
        const picture = this.at(video.currentTime);
        if (picture) this.onShown(picture);
      });
    }
  }

  /** The rungs that this browser can show, best first. */
  static rungs() {
    const can = (/** @type {string} */ codec) => Boolean(Source?.isTypeSupported(`video/mp4; codecs="${codec}"`));
    return [...(can("hvc1.1.6.L93.B0") ? ["hevc"] : []), ...(can("avc1.42c01f") ? ["h264"] : []), "jpeg"];
  }

  /** Forget the picture and take it off the screen: another edge's may not stand there, nor that of another session. */
  clear() {
    this.reset();
    const { video, image } = this;
    for (const old of [video.src, image.src]) if (old) URL.revokeObjectURL(old);
    image.onload = null;
    image.removeAttribute("src");
    video.removeAttribute("src");
    video.load(); // else its last picture stays
    image.hidden = video.hidden = true;
  }

  /** Begin anew with the same edge: the last picture stays on the screen until there is another. */
  reset() {
    this.stream = -1;
    this.waiting = [];
    this.buffer = null;
    this.pictures = [];
    this.live = true;
  }

  /** @param {{stream: number, codec: string}} start */
  start(start) {
    this.reset();
    this.stream = start.stream;
    const type = `video/mp4; codecs="${start.codec}"`;
    if (!Source?.isTypeSupported(type)) {
      this.onFailed();
      return;
    }
    this.image.hidden = true;
    this.video.hidden = false;
    if (MANAGED) this.video.disableRemotePlayback = true;
    const source = new Source();
    const old = this.video.src;
    this.video.src = URL.createObjectURL(source);
    if (old) URL.revokeObjectURL(old);
    source.addEventListener("sourceopen", () => {
      if (this.stream !== start.stream) return;
      const buffer = source.addSourceBuffer(type);
      buffer.addEventListener("updateend", () => this.pump());
      this.buffer = buffer;
      this.pump();
    }, { once: true });
  }

  /** @param {{stream: number}} head @param {Uint8Array} data */
  init(head, data) {
    if (head.stream === this.stream) this.append(data);
  }

  /** @param {{stream: number, media: number, duration: number, frame: number, captured: number}} head @param {Uint8Array} data */
  fragment(head, data) {
    if (head.stream !== this.stream) return;
    this.duration = head.duration;
    this.pictures.push({ media: head.media, frame: head.frame, captured: head.captured });
    const { buffered } = this.video; // whoever has paused for long plays on from there
    while (this.pictures.length > 1 && buffered.length && this.pictures[1].media <= buffered.start(0)) this.pictures.shift();
    this.append(data);
  }

  /** @param {{frame: number, captured: number}} head @param {Uint8Array} data */
  jpeg(head, data) {
    if (!this.live) return;
    this.image.onload = () => this.onShown({ media: 0, frame: head.frame, captured: head.captured });
    this.video.hidden = true;
    this.image.hidden = false;
    URL.revokeObjectURL(this.image.src);
    this.image.src = URL.createObjectURL(new Blob([data], { type: "image/jpeg" }));
  }

  /** Stop where it is. */
  pause() {
    this.live = false;
    this.video.pause();
  }

  /**
   * Seconds from here; into the future as far as there is any.
   * @param {number} seconds
   */
  step(seconds) {
    const { buffered } = this.video;
    if (!buffered.length) return;
    this.live = false;
    const at = this.video.currentTime + seconds;
    this.video.currentTime = Math.max(buffered.start(0) + 0.01, Math.min(at, buffered.end(buffered.length - 1) - 0.01));
  }

  /**
   * Stop at the picture of a time, where it is still at hand.
   * @param {number} captured @returns {boolean} whether it is
   */
  show(captured) {
    const picture = this.pictures.filter((one) => one.captured <= captured + 1).pop();
    const { buffered } = this.video;
    if (!picture || !buffered.length || picture.media < buffered.start(0)) return false;
    this.pause();
    this.video.currentTime = Math.min(picture.media + 0.01, buffered.end(buffered.length - 1) - 0.01);
    return true;
  }

  /** Play on from here; of single pictures none is kept. */
  play() {
    if (this.stream < 0) return this.goLive();
    this.video.playbackRate = 1;
    this.video.play().catch(() => {});
  }

  /** To the newest picture. */
  goLive() {
    this.live = true;
    this.catchUp(true);
  }

  /** @param {number} media @returns {Picture | undefined} */
  at(media) {
    let low = 0;
    let high = this.pictures.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.pictures[middle].media <= media + 0.002) low = middle + 1;
      else high = middle;
    }
    return this.pictures[low - 1];
  }

  /** @param {Uint8Array} data */
  append(data) {
    this.waiting.push(data);
    if (this.waiting.length > MOST_WAITING) this.onFailed();
    this.pump();
  }

  pump() {
    const { buffer, video } = this;
    if (!buffer || buffer.updating) return;
    try {
      const { buffered } = buffer;
      if (buffered.length && video.currentTime - buffered.start(0) > KEPT_S + 10) {
        buffer.remove(0, video.currentTime - KEPT_S);
        return;
      }
      if (this.waiting.length) {
        buffer.appendBuffer(joined(this.waiting.splice(0)));
        return;
      }
    } catch (error) {
      if (error instanceof DOMException && error.name === "QuotaExceededError" && (video.currentTime > 10 || !this.live)) {
        if (video.currentTime > 10) buffer.remove(0, video.currentTime - 5); // else who has paused keeps the picture
      } else if (!(error instanceof DOMException && error.name === "InvalidStateError")) this.onFailed();
      return;
    }
    this.catchUp(false);
  }

  /**
   * Keep to the newest picture.
   * @param {boolean} jump
   */
  catchUp(jump) {
    const { video } = this;
    const newest = this.pictures[this.pictures.length - 1];
    if (!this.live || !newest || !video.buffered.length) return;
    const behind = newest.media - video.currentTime;
    if (jump || behind > BEHIND_S || behind < -1) video.currentTime = newest.media;
    video.playbackRate = behind > HURRY_FRAMES * this.duration ? 1.5 : 1;
    if (video.paused) this.play();
  }
}

/** @param {Uint8Array[]} parts */
function joined(parts) {
  if (parts.length === 1) return parts[0];
  const whole = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    whole.set(part, at);
    at += part.length;
  }
  return whole;
}
