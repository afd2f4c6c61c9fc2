// The controls below a pair: play or pause, single frames, one scrub bar for both clips, speed.
//
// They outlive the pairs: `player()` gives the LockStep of the pair that is shown now, or null.

const SCRUB_STEPS = 1000;
const TENTHS = { minimumFractionDigits: 1, maximumFractionDigits: 1 };
const SECONDS = new Intl.NumberFormat(document.documentElement.lang, TENTHS); // 2.5 or 2,5

export class PlayerControls {
  // `on` holds: scrubbed(), used(name). `words` are the texts of the page, by name.
  constructor(root, player, words, on) {
    this.root = root;
    this.player = player;
    this.words = words;
    this.rate = 1;
    this.toggleButton = root.querySelector("[data-toggle]");
    this.scrub = root.querySelector("[data-scrub]");
    this.speeds = [...root.querySelectorAll("[data-speed]")];
    this.toggleButton.addEventListener("click", () => {
      this.toggle();
      on.used("pause");
    });
    for (const button of root.querySelectorAll("[data-step]")) {
      button.addEventListener("click", () => {
        this.player()?.step(Number(button.dataset.step));
        on.used("step");
      });
    }
    for (const button of this.speeds) {
      button.addEventListener("click", () => {
        this.setRate(Number(button.dataset.speed));
        on.used("speed");
      });
    }
    this.scrub.addEventListener("input", () => {
      const player = this.player();
      if (!player) return;
      if (!this.dragging) on.scrubbed();
      this.dragging = true;
      player.pause();
      player.seek((this.scrub.value / SCRUB_STEPS) * player.duration);
    });
    this.scrub.addEventListener("change", () => (this.dragging = false));
    // After the mouse or a finger the arrow keys shall answer again; who came by keyboard stays on the bar.
    this.scrub.addEventListener("pointerup", () => this.scrub.blur());
    root.hidden = false;
    this.showPlaying(false);
  }

  toggle() {
    const player = this.player();
    if (player?.playing) player.pause();
    else player?.resume();
  }

  setRate(rate) {
    this.rate = rate;
    for (const button of this.speeds) button.setAttribute("aria-pressed", String(Number(button.dataset.speed) === rate));
    this.player()?.setRate(rate);
  }

  showPlaying(playing) {
    this.toggleButton.toggleAttribute("data-playing", playing);
    this.toggleButton.setAttribute("aria-label", playing ? this.words.pause : this.words.play);
  }

  showPosition(now, total) {
    if (this.dragging || !total) return;
    this.scrub.value = (now / total) * SCRUB_STEPS;
    this.scrub.style.setProperty("--at", `${(100 * now) / total}%`);
    this.scrub.setAttribute(
      "aria-valuetext",
      this.words.position.replace("{seconds}", SECONDS.format(now)).replace("{total}", SECONDS.format(total)),
    );
  }
}
