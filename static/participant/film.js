// Plays one film, with what PlayerControls asks of a player: play, pause, jump, speed, and whether it was seen whole.

const PATIENCE_MS = 20000;

export class Film {
  // `on` holds: firstFrame(), trouble(), seenOnce(), position(now, total), playing(is)
  constructor(video, fps, on) {
    this.video = video;
    this.frameS = 1 / fps;
    this.on = on;
    this.shown = false;
    this.seenUntil = 0; // watched from the beginning up to here, without gaps
    this.playedFrom = 0; // where the stretch began that is playing now
    this.seenWhole = false;
    video.controls = false;
    video.muted = true;
    video.addEventListener("error", () => this.on.trouble());
    video.addEventListener("play", () => this.#started());
    video.addEventListener("pause", () => this.on.playing(false));
    video.addEventListener("ended", () => this.#ended());
    video.addEventListener("loadedmetadata", () => this.#tellPosition());
    document.addEventListener("visibilitychange", () => document.hidden && this.pause());
    if (video.error) this.on.trouble();
  }

  get duration() {
    return this.video.duration || 0;
  }

  get playing() {
    return !this.video.paused && !this.video.ended;
  }

  async resume() {
    if (this.video.ended) this.seek(0);
    const timer = setTimeout(() => this.shown || this.on.trouble(), PATIENCE_MS);
    try {
      await this.video.play();
    } catch (error) {
      if (error.name !== "AbortError" && error.name !== "NotAllowedError") this.on.trouble();
    } finally {
      clearTimeout(timer);
    }
  }

  pause() {
    this.video.pause();
  }

  seek(second) {
    this.video.currentTime = Math.max(0, Math.min(second, this.duration));
    this.playedFrom = this.video.currentTime;
    this.#tellPosition();
  }

  setRate(rate) {
    this.video.playbackRate = rate;
  }

  #started() {
    this.playedFrom = this.video.currentTime;
    this.on.playing(true);
    this.#announceFirstFrame();
    this.#tick();
  }

  #announceFirstFrame() {
    if (this.shown) return;
    const told = () => {
      if (this.shown) return;
      this.shown = true;
      this.on.firstFrame();
    };
    if (this.video.requestVideoFrameCallback) this.video.requestVideoFrameCallback(told);
    else this.video.addEventListener("timeupdate", told, { once: true });
  }

  #tick() {
    requestAnimationFrame(() => {
      if (!this.playing) return;
      this.#remember();
      this.#tellPosition();
      this.#tick();
    });
  }

  // What has been watched without a gap from the beginning; jumping ahead does not count.
  #remember() {
    if (this.playedFrom > this.seenUntil + this.frameS) return;
    this.seenUntil = Math.max(this.seenUntil, this.video.currentTime);
  }

  #ended() {
    this.#remember();
    this.#tellPosition();
    if (this.seenWhole || this.seenUntil < this.duration - 2 * this.frameS) return;
    this.seenWhole = true;
    this.on.seenOnce();
  }

  #tellPosition() {
    this.on.position(this.video.currentTime, this.duration);
  }
}
