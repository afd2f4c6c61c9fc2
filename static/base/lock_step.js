// Plays two clips as one: one clock, one position, one speed; they start, pause, jump and loop together.
//
// The longer clip is the master clock, the left one of equals. The other follows: a small drift is taken out by playing
// a little faster or slower, a large one by jumping. When one of them runs out of data both wait.

const LARGE_DRIFT_S = 0.25;
const CATCH_UP = 3; // change of playback rate per second of drift
const RATE_CHANGE_LIMIT = 0.3;
const REST_MS = 500; // on the last frame, before the next round
const PATIENCE_MS = 20000; // without enough data to play

export class LockStep {
  // `on` holds: firstFrame(), trouble(), gestureNeeded(), roundEnded(), seenOnce(), position(now, total), playing(is),
  // stalled(milliseconds)
  constructor(left, right, fps, on) {
    this.videos = [left, right];
    this.frameS = 1 / fps;
    this.on = on;
    this.rate = 1;
    this.loop = true;
    this.playing = false;
    this.stopped = false;
    this.shown = false;
    this.seenUntil = 0; // watched from the beginning up to here, without gaps
    this.playedFrom = 0; // where the stretch began that is playing now
    this.seenWhole = false;
    this.largestDriftMs = 0;
    this.stalls = 0;
    this.stalledMs = 0;
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

  // Seconds, of the longer clip; 0 while that is not known.
  get duration() {
    return Math.max(...this.videos.map((video) => video.duration || 0));
  }

  get position() {
    return this.#clocks()[0].currentTime;
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
    this.#halt();
    this.#jump(0);
    if (!this.shown) this.#announceFirstFrame();
    await this.#playBoth();
  }

  // From here on; at the end from the beginning.
  async resume() {
    if (this.stopped || this.playing) return;
    if (!this.shown || this.#atEnd()) await this.play({ loop: this.loop });
    else await this.#playBoth();
  }

  // Milliseconds of the left and of the right clip that have been played, at whatever speed; what was played twice
  // counts once.
  get watchedMs() {
    return this.videos.map(({ played }) => {
      const lengths = Array.from({ length: played.length }, (_, range) => played.end(range) - played.start(range));
      return Math.round(1000 * lengths.reduce((sum, each) => sum + each, 0));
    });
  }

  pause() {
    this.#halt();
  }

  // Both to this second, playing on if they were playing.
  seek(second) {
    if (this.stopped || !this.shown) return;
    clearTimeout(this.rest);
    this.#jump(Math.max(0, Math.min(second, this.duration)));
    this.#tellPosition();
  }

  // One frame on or back, and stand still there.
  step(frames) {
    if (this.stopped || !this.shown) return;
    this.#halt();
    const frame = Math.round(this.position / this.frameS) + frames;
    this.seek(Math.min(frame * this.frameS, this.duration - this.frameS / 2));
  }

  setRate(rate) {
    this.rate = rate;
    for (const video of this.videos) video.playbackRate = rate;
  }

  stop() {
    this.stopped = true;
    this.#halt();
    this.abort.abort();
  }

  #clocks() {
    const [left, right] = this.videos;
    return (right.duration || 0) > (left.duration || 0) + this.frameS ? [right, left] : [left, right];
  }

  #jump(second) {
    this.playedFrom = second;
    this.starvedSince = undefined;
    for (const video of this.videos) {
      video.currentTime = Math.min(second, video.duration || second);
      video.playbackRate = this.rate;
    }
  }

  #halt() {
    const was = this.playing;
    this.playing = false;
    clearTimeout(this.rest);
    cancelAnimationFrame(this.frame);
    this.#endStall();
    this.videos.forEach((video) => video.pause());
    if (was) this.on.playing(false);
  }

  async #playBoth() {
    clearTimeout(this.rest);
    this.playing = true;
    this.playedFrom = this.position;
    this.on.playing(true);
    try {
      await Promise.all(this.videos.filter((video) => !this.#isOver(video)).map((video) => video.play()));
    } catch (error) {
      if (this.stopped || error.name === "AbortError") return;
      this.#halt();
      if (error.name === "NotAllowedError") this.on.gestureNeeded();
      else this.#fail();
    }
    if (this.playing) this.#tick();
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
      this.#remember();
      if (this.#atEnd()) this.#endRound();
      else {
        this.#align();
        this.#tick();
      }
      this.#tellPosition();
    });
  }

  #isOver(video) {
    return video.ended || video.currentTime >= video.duration - this.frameS / 2;
  }

  #atEnd() {
    return this.videos.every((video) => this.#isOver(video));
  }

  // What has been watched without a gap from the beginning; jumping ahead does not count.
  #remember() {
    if (this.playedFrom <= this.seenUntil + this.frameS) this.seenUntil = Math.max(this.seenUntil, this.position);
  }

  #endRound() {
    const seen = this.playedFrom <= this.seenUntil + this.frameS;
    this.videos.forEach((video) => video.pause());
    if (this.loop) this.rest = setTimeout(() => this.play({ loop: true }), REST_MS); // still playing, says the button
    else this.#halt();
    if (seen && !this.seenWhole) {
      this.seenWhole = true;
      this.on.seenOnce();
    }
    this.on.roundEnded();
  }

  #align() {
    const [lead, follow] = this.#clocks();
    const starved = this.videos.map(
      (video) => !this.#isOver(video) && video.readyState < HTMLMediaElement.HAVE_FUTURE_DATA,
    );
    if (starved.some(Boolean)) {
      this.videos.forEach((video, index) => starved[index] || video.pause());
      if (this.starvedSince === undefined) {
        this.starvedSince = performance.now();
        this.stalls += 1;
      }
      if (performance.now() - this.starvedSince > PATIENCE_MS) this.#fail();
      return;
    }
    this.#endStall();
    for (const video of this.videos) if (video.paused && !this.#isOver(video)) video.play().catch(() => {});
    if (this.#isOver(follow)) return;
    const drift = lead.currentTime - follow.currentTime;
    this.largestDriftMs = Math.max(this.largestDriftMs, Math.round(1000 * Math.abs(drift)));
    if (Math.abs(drift) > LARGE_DRIFT_S) follow.currentTime = lead.currentTime;
    const change = Math.abs(drift) > this.frameS / 2 ? CATCH_UP * drift : 0;
    lead.playbackRate = this.rate;
    follow.playbackRate = this.rate * (1 + Math.max(-RATE_CHANGE_LIMIT, Math.min(RATE_CHANGE_LIMIT, change)));
  }

  #endStall() {
    if (this.starvedSince === undefined) return;
    const lasted = Math.round(performance.now() - this.starvedSince);
    this.starvedSince = undefined;
    this.stalledMs += lasted;
    this.on.stalled(lasted);
  }

  #tellPosition() {
    this.on.position(this.position, this.duration);
  }

  #followVisibility() {
    if (this.stopped || !this.shown) return;
    if (document.hidden) {
      this.hiddenWhilePlaying = this.playing;
      this.#halt();
    } else if (this.hiddenWhilePlaying) {
      this.hiddenWhilePlaying = false;
      this.#playBoth();
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
