// Plays two clips as one: they start together, loop together, and stay within a frame of each other.
//
// The left clip is the master clock. The right one follows: a small drift is taken out by playing a little faster or
// slower, a large one by jumping. When one of them runs out of data both wait.

const LARGE_DRIFT_S = 0.25;
const CATCH_UP = 3; // change of playback rate per second of drift
const RATE_CHANGE_LIMIT = 0.3;
const REST_MS = 500; // on the last frame, before the next round
const PATIENCE_MS = 20000; // without enough data to play

export class LockStep {
  // `on` holds: firstFrame(), trouble(), gestureNeeded(), roundEnded()
  constructor(left, right, fps, on) {
    this.videos = [left, right];
    this.frameS = 1 / fps;
    this.on = on;
    this.loop = true;
    this.playing = false;
    this.stopped = false;
    this.shown = false;
    this.abort = new AbortController();
    const { signal } = this.abort;
    for (const video of this.videos) {
      video.loop = false;
      video.controls = false;
      video.muted = true;
      video.addEventListener("error", () => this.#fail(), { signal });
    }
    document.addEventListener("visibilitychange", () => this.#followVisibility(), { signal });
  }

  // Resolves when both could play to their end without waiting; false when one cannot be loaded.
  async ready() {
    const settled = await Promise.all(this.videos.map((video) => canPlay(video, this.abort.signal)));
    return !this.stopped && settled.every(Boolean);
  }

  // From the first frame; `loop` false plays one round.
  async play({ loop }) {
    this.loop = loop;
    if (!(await this.ready())) {
      this.#fail();
      return;
    }
    clearTimeout(this.rest);
    this.#pauseBoth();
    for (const video of this.videos) {
      video.currentTime = 0;
      video.playbackRate = 1;
    }
    if (!this.shown) this.#announceFirstFrame();
    await this.#playBoth();
    if (this.playing) this.#tick();
  }

  stop() {
    this.stopped = true;
    this.playing = false;
    clearTimeout(this.rest);
    cancelAnimationFrame(this.frame);
    this.abort.abort();
    this.#pauseBoth();
  }

  async #playBoth() {
    this.playing = true;
    try {
      await Promise.all(this.videos.map((video) => video.play()));
    } catch (error) {
      this.playing = false;
      if (this.stopped || error.name === "AbortError") return;
      if (error.name === "NotAllowedError") this.on.gestureNeeded();
      else this.#fail();
    }
  }

  #pauseBoth() {
    this.videos.forEach((video) => video.pause());
  }

  #announceFirstFrame() {
    Promise.all(this.videos.map(frameShown)).then(() => {
      if (this.stopped || this.shown) return;
      this.shown = true;
      this.on.firstFrame();
    });
  }

  #tick() {
    cancelAnimationFrame(this.frame);
    this.frame = requestAnimationFrame(() => {
      if (!this.playing || this.stopped) return;
      if (this.#atEnd()) this.#endRound();
      else {
        this.#align();
        this.#tick();
      }
    });
  }

  #atEnd() {
    return this.videos.some((video) => video.ended || video.currentTime >= video.duration - this.frameS / 2);
  }

  #endRound() {
    this.playing = false;
    this.#pauseBoth();
    this.on.roundEnded();
    if (this.loop) this.rest = setTimeout(() => this.play({ loop: true }), REST_MS);
  }

  #align() {
    const [left, right] = this.videos;
    const starved = this.videos.map((video) => video.readyState < HTMLMediaElement.HAVE_FUTURE_DATA);
    if (starved.some(Boolean)) {
      this.videos.forEach((video, index) => starved[index] || video.pause());
      this.starvedSince ??= performance.now();
      if (performance.now() - this.starvedSince > PATIENCE_MS) this.#fail();
      return;
    }
    this.starvedSince = undefined;
    for (const video of this.videos) if (video.paused) video.play().catch(() => {});
    const drift = left.currentTime - right.currentTime;
    if (Math.abs(drift) > LARGE_DRIFT_S) right.currentTime = left.currentTime;
    const change = Math.abs(drift) > this.frameS / 2 ? CATCH_UP * drift : 0;
    right.playbackRate = 1 + Math.max(-RATE_CHANGE_LIMIT, Math.min(RATE_CHANGE_LIMIT, change));
  }

  #followVisibility() {
    if (this.stopped || !this.shown) return;
    if (document.hidden) {
      this.hiddenWhilePlaying = this.playing;
      this.playing = false;
      this.#pauseBoth();
    } else if (this.hiddenWhilePlaying) {
      this.hiddenWhilePlaying = false;
      this.#playBoth().then(() => this.playing && this.#tick());
    }
  }

  #fail() {
    if (this.stopped) return;
    this.stop();
    this.on.trouble();
  }
}

function canPlay(video, signal) {
  if (video.readyState >= HTMLMediaElement.HAVE_FUTURE_DATA) return true;
  if (video.error) return false;
  return new Promise((resolve) => {
    const finish = (fine) => {
      clearTimeout(timer);
      resolve(fine);
    };
    const timer = setTimeout(() => finish(false), PATIENCE_MS);
    video.addEventListener("canplay", () => finish(true), { once: true, signal });
    video.addEventListener("error", () => finish(false), { once: true, signal });
    signal.addEventListener("abort", () => finish(false), { once: true });
    if (video.networkState === HTMLMediaElement.NETWORK_IDLE) video.load();
  });
}

function frameShown(video) {
  return new Promise((resolve) => {
    if (video.requestVideoFrameCallback) video.requestVideoFrameCallback(resolve);
    else video.addEventListener("timeupdate", resolve, { once: true });
  });
}
