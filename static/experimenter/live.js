// Keeps an experimenter's page up to date: the server sends the parts that changed.

import { morph } from "../base/morph.js";

const path = document.querySelector("[data-live]").dataset.live;
const state = document.querySelector("[data-live-state]");
const events = new EventSource(path);

const parts = new Map(); // by name: the pieces of their HTML, of which the server sends those that changed

events.addEventListener("open", () => show("live", "live"));
events.addEventListener("fragment", (event) => {
  const { name, pieces, changed } = JSON.parse(event.data);
  parts.set(name, pieces ?? Object.assign(parts.get(name), changed));
  const part = document.querySelector(`[data-fragment="${CSS.escape(name)}"]`);
  if (part) morph(part, parts.get(name).join(""));
});
events.addEventListener("gone", () => location.reload());
events.addEventListener("error", () => {
  show("lost", "reconnecting …");
  if (events.readyState === EventSource.CLOSED) setTimeout(() => location.reload(), 5000);
});

function show(name, text) {
  state.dataset.state = name;
  state.textContent = text;
}
