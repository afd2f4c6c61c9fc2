// Sliders that set a robot, and the film that follows. Every place a slider is let go of is kept in the browser until the
// server has it; the server answers with the nearest film there is, and the page asks on until there is the exact one.

import { Outbox } from "./outbox.js";

const KEYS_REST_MS = 300; // arrow keys move a slider step by step; what is meant is where it comes to rest
const LOOK_MS = 1000;
const PATIENT_MS = 5000;
const PATIENT_AFTER = 40; // looks
const REFUSED_MS = 4000; // so long a refusal can be read

const page = document.querySelector("[data-setting]");
const find = (name) => page.querySelector(`[data-${name}]`);
const words = Object.fromEntries(
  Object.entries(page.dataset)
    .filter(([name]) => name.startsWith("say"))
    .map(([name, text]) => [name[3].toLowerCase() + name.slice(4), text]),
);
const form = find("form");
const film = find("film");
const shown = find("shown");
const status = find("status");
const goOn = find("go-on");
const sliders = [...page.querySelectorAll("[data-slider]")].map((root) => ({
  name: root.dataset.slider,
  places: JSON.parse(root.dataset.places),
  input: root.querySelector("input"),
  filmed: root.querySelector("[data-filmed]"),
}));
const still = matchMedia("(prefers-reduced-motion: reduce)");
const outbox = new Outbox(page.dataset.who);

let state = JSON.parse(page.dataset.state);
let since = performance.now();
let sending = false;
let waiting = null; // what is to be sent after what is being sent: the newest setting alone
let resting = null;
let looks = 0;
let looking = null;

addEventListener("pageshow", (event) => event.persisted && location.reload());
for (const slider of sliders) {
  slider.input.addEventListener("input", () => tell(slider));
  slider.input.addEventListener("change", () => rest(slider.name));
}
find("reset").hidden = false;
find("reset").addEventListener("click", () => {
  for (const slider of sliders) {
    slider.input.value = 0;
    tell(slider);
  }
  rest("");
});
form.addEventListener("submit", (event) => {
  event.preventDefault();
  goOn.disabled = true;
  send({ moved: "", goes_on: "true" });
});
film.addEventListener("error", () => film.currentSrc && (shown.textContent = words.unplayable));
setUp();

async function setUp() {
  for (const slider of sliders) tell(slider);
  const [earlier] = outbox.pending();
  if (earlier) await deliver(earlier);
  else show(state);
}

function tell(slider) {
  slider.input.setAttribute("aria-valuetext", slider.places[slider.input.value]);
  slider.input.title = slider.places[slider.input.value];
}

// --- saving ------------------------------------------------------------------------------------------------------------

function rest(moved) {
  clearTimeout(resting);
  clearTimeout(looking);
  resting = setTimeout(() => send({ moved }), KEYS_REST_MS);
}

function send(what) {
  clearTimeout(resting);
  if (sending) {
    waiting = { ...what, goes_on: what.goes_on ?? waiting?.goes_on };
    return;
  }
  const fields = Object.fromEntries(new FormData(form));
  fields.moved = what.moved;
  if (what.goes_on) fields.goes_on = what.goes_on;
  fields.response_time_ms = Math.round(performance.now() - since);
  since = performance.now();
  deliver(outbox.add(form.getAttribute("action"), fields));
}

async function deliver(entry) {
  sending = true;
  status.textContent = words.saving;
  try {
    const answer = await outbox.deliver(entry, () => (status.textContent = words.notSaved));
    if (answer.next_path) {
      location.replace(answer.next_path);
      return;
    }
    sending = false;
    status.textContent = words.saved;
    looks = 0;
    if (answer.film) show(answer);
  } catch {
    status.textContent = words.refused;
    setTimeout(() => location.replace(page.dataset.here), REFUSED_MS);
    return;
  }
  const next = waiting;
  waiting = null;
  if (next) send(next);
}

// --- the film ----------------------------------------------------------------------------------------------------------

function show(answer) {
  state = answer;
  if (film.getAttribute("src") !== state.film.video) {
    film.poster = state.film.poster;
    film.src = state.film.video;
  }
  if (!still.matches) film.play().catch(() => {}); // the browser's own controls are there
  const says = state.exact ? words.exact : words.near;
  if (shown.textContent !== says) shown.textContent = says;
  shown.dataset.exact = state.exact ? "yes" : "no";
  for (const slider of sliders) {
    const at = String(state.filmed[slider.name]);
    slider.filmed.hidden = at === slider.input.value;
    slider.filmed.textContent = words.filmed.replace("{place}", slider.places[at]);
  }
  clearTimeout(looking);
  if (!state.exact) looking = setTimeout(look, (looks += 1) < PATIENT_AFTER ? LOOK_MS : PATIENT_MS);
}

// Whether the film of exactly this setting is there; meanwhile the server knows that somebody waits for it.
async function look() {
  if (sending) return;
  try {
    const response = await fetch(page.dataset.here, { headers: { Accept: "application/json" } });
    const answer = response.ok ? await response.json() : null;
    if (response.status === 409 || response.status === 401) location.reload();
    else if (answer?.film && !sending && isAsSet(answer)) {
      show(answer);
      return;
    }
  } catch {
    // the network is away; the next look may find it again
  }
  looking = setTimeout(look, PATIENT_MS);
}

function isAsSet(answer) {
  return sliders.every((slider) => String(answer.stops[slider.name]) === slider.input.value);
}
