// A page that waits for something: looks again every few seconds, and goes where the server then leads.

import { morph } from "./morph.js";

const page = document.querySelector("[data-refresh-s]");
const wait = () => setTimeout(look, 1000 * Number(page.dataset.refreshS));

async function look() {
  try {
    const response = await fetch(location.href, { headers: { Accept: "text/html", "X-Unattended": "1" }, signal: AbortSignal.timeout(10000) });
    if (response.ok) follow(new DOMParser().parseFromString(await response.text(), "text/html"), response.url);
  } catch {
    // the network is away; the next look may find it again
  }
  wait();
}

function follow(fresh, url) {
  if (fresh.querySelector("[data-page]")?.dataset.page !== page.dataset.page) {
    location.replace(url);
    return;
  }
  for (const part of page.querySelectorAll("[data-fragment]")) {
    const wanted = fresh.querySelector(`[data-fragment="${CSS.escape(part.dataset.fragment)}"]`);
    if (wanted) morph(part, wanted.innerHTML);
  }
}

addEventListener("pageshow", (event) => event.persisted && location.reload());
wait();
