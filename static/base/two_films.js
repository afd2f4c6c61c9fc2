// Plays two films as one, with one clock, one bar and one speed, on pages that show them and ask nothing.

import { listen } from "./hotkeys.js";
import { LockStep } from "./lock_step.js";
import { PlayerControls } from "./player_controls.js";

const page = document.querySelector("[data-two-films]");
const words = { play: page.dataset.sayPlay, pause: page.dataset.sayPause, position: page.dataset.sayPosition };
const still = matchMedia("(prefers-reduced-motion: reduce)");
const trouble = page.querySelector("[data-trouble]");
const films = [...page.querySelectorAll("[data-film]")];

const player = new LockStep(...films, Number(page.dataset.fps), {
  firstFrame: () => {},
  seenOnce: () => {},
  roundEnded: () => {},
  stalled: () => {},
  gestureNeeded: () => {}, // the bar has a button to play
  trouble: () => {
    trouble.textContent = trouble.dataset.trouble;
    for (const film of films) film.controls = true; // one of them may still play
  },
  position: (now, total) => controls.showPosition(now, total),
  playing: (is) => controls.showPlaying(is),
});
const controls = new PlayerControls(page.querySelector("[data-player]"), () => player, words, {
  scrubbed: () => {},
  used: () => {},
});
listen(() => page);
player.loop = !still.matches;
if (!still.matches) player.play({ loop: true });
