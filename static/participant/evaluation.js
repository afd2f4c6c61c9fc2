// Watching and rating one robot. Digits rate, Enter saves; a rating is kept in the browser until the server has it.

import { Film } from "./film.js";
import { listen } from "../base/hotkeys.js";
import { Outbox } from "./outbox.js";
import { PlayerControls } from "../base/player_controls.js";

const LOOK_MS = 3000; // physical mode: whether the operator has taken the trial back
const REFUSED_MS = 4000; // so long a refusal can be read

const page = document.querySelector("[data-evaluation]");
const find = (name) => page.querySelector(`[data-${name}]`);
const words = Object.fromEntries(
  Object.entries(page.dataset)
    .filter(([name]) => name.startsWith("say"))
    .map(([name, text]) => [name[3].toLowerCase() + name.slice(4), text]),
);
const form = find("ratings");
const scales = [...form.querySelectorAll("[data-rating]")];
const status = find("status");
const save = find("save");
const still = matchMedia("(prefers-reduced-motion: reduce)");
const byKeyboard = matchMedia("(any-hover: hover)");
const outbox = new Outbox(page.dataset.who);

let open = page.dataset.watchFirst !== "yes";
let since = performance.now();
let sending = false;
let film = null;

find("late").remove();
addEventListener("pageshow", (event) => event.persisted && location.reload());
form.addEventListener("submit", (event) => {
  event.preventDefault();
  send();
});
form.addEventListener("change", mark);
form.addEventListener("focusin", (event) => mark(event.target.closest("[data-rating]")));
addEventListener("keydown", press);
listen(() => page);
setUp();

async function setUp() {
  setOpen(open);
  const [earlier] = outbox.pending();
  if (earlier) {
    await deliver(earlier);
    return;
  }
  const video = page.querySelector("video");
  if (video) playFilm(video);
  else if (page.dataset.changing === "no") setTimeout(look, LOOK_MS);
}

// --- the film ----------------------------------------------------------------------------------------------------------

function playFilm(video) {
  const controls = new PlayerControls(find("player"), () => film, words, { scrubbed: () => {}, used: () => {} });
  film = new Film(video, Number(page.dataset.fps), {
    firstFrame: () => (since = performance.now()),
    seenOnce: () => open || setOpen(true, words.nowRate),
    position: (now, total) => controls.showPosition(now, total),
    playing: (is) => controls.showPlaying(is),
    trouble: showTrouble,
  });
  if (!still.matches) film.resume();
}

function showTrouble() {
  const notice = find("notice");
  find("notice-text").textContent = words.unplayable;
  const button = find("notice-button");
  button.textContent = words.loadAgain;
  button.onclick = () => location.reload();
  notice.hidden = false;
}

// --- rating ------------------------------------------------------------------------------------------------------------

function setOpen(is, said) {
  open = is;
  for (const scale of scales) scale.disabled = !is;
  save.disabled = !is;
  status.textContent = said ?? (is ? (byKeyboard.matches ? words.keys : "") : words.watchFirst);
  mark();
}

function given(scale) {
  return scale.querySelector("input:checked");
}

// Shows which scale the next digit is for: the one in hand, else the first that is empty.
function mark(inHand) {
  const active = inHand instanceof Element ? inHand : scales.find((scale) => !given(scale));
  for (const scale of scales) scale.toggleAttribute("data-active", open && scale === active);
}

function press(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat || !open || sending) return;
  if (event.target.matches("textarea")) return;
  if (/^[1-5]$/.test(event.key)) {
    const scale = scales.find((each) => each.hasAttribute("data-active")) ?? scales.at(-1);
    scale.querySelector(`input[value="${event.key}"]`).checked = true;
    mark();
  } else if (event.key === "Backspace") {
    const last = scales.findLast(given);
    if (last) given(last).checked = false;
    mark();
  } else if (event.key === "Enter" && !event.target.closest("button, a, summary")) {
    form.requestSubmit();
  } else {
    return;
  }
  event.preventDefault();
}

// --- saving ------------------------------------------------------------------------------------------------------------

async function send() {
  if (sending || !open) return;
  film?.pause();
  const fields = Object.fromEntries(new FormData(form));
  fields.response_time_ms = Math.round(performance.now() - since);
  await deliver(outbox.add(form.getAttribute("action"), fields));
}

async function deliver(entry) {
  sending = true;
  save.disabled = true;
  status.textContent = words.saving;
  try {
    const answer = await outbox.deliver(entry, () => (status.textContent = words.notSaved));
    location.replace(answer.next_path ?? page.dataset.here);
  } catch {
    status.textContent = words.refused;
    setTimeout(() => location.replace(page.dataset.here), REFUSED_MS);
  }
}

async function look() {
  if (sending) return;
  try {
    const response = await fetch(page.dataset.here, { headers: { Accept: "application/json" } });
    const now = response.ok ? await response.json() : null;
    if (now && !(now.state === "rating" && String(now.trial) === page.dataset.trial)) {
      location.replace(page.dataset.here);
      return;
    }
  } catch {
    // the network is away; the next look may find it again
  }
  setTimeout(look, LOOK_MS);
}
