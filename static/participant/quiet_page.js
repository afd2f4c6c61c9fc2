// Small helps on a participant's quiet pages; every one of them works without.

import { Outbox } from "./outbox.js";

const LONGEST_WAIT_S = 120; // for an answer that is still on its way

for (const button of document.querySelectorAll("[data-print]")) {
  button.hidden = false;
  button.addEventListener("click", () => print());
}

for (const button of document.querySelectorAll("[data-copy]")) {
  button.hidden = false;
  button.addEventListener("click", async () => {
    const field = document.getElementById(button.dataset.copy);
    field.select();
    try {
      await navigator.clipboard.writeText(field.value); // only on HTTPS and localhost
    } catch {
      document.execCommand("copy");
    }
    document.querySelector("[data-copy-status]").textContent = button.dataset.copied;
  });
}

for (const form of document.querySelectorAll("form[data-once]")) {
  form.addEventListener("submit", (event) => {
    if (form.dataset.sent) event.preventDefault();
    form.dataset.sent = "yes";
  });
}
addEventListener("pageshow", () => {
  for (const form of document.querySelectorAll("[data-sent]")) delete form.dataset.sent;
});

const returning = document.querySelector("[data-return-after-s]");
if (returning) goBack(returning);

// Back to a recruitment panel by itself, so that nobody's clock runs on there; but only when every answer has arrived,
// and not when the person wants to stay.
function goBack(place) {
  const status = place.querySelector("[data-return-status]");
  const stay = place.querySelector("[data-stay]");
  const outbox = new Outbox(place.dataset.who);
  const begun = Date.now();
  let staying = false;
  stay.hidden = false;
  stay.addEventListener("click", () => {
    staying = true;
    stay.hidden = true;
    status.textContent = "";
  });
  status.textContent = status.dataset.soon;
  const timer = setInterval(() => {
    const passed_s = (Date.now() - begun) / 1000;
    if (staying) {
      clearInterval(timer);
    } else if (outbox.pending().length && passed_s < LONGEST_WAIT_S) {
      status.textContent = status.dataset.sending;
    } else if (passed_s >= Number(place.dataset.returnAfterS)) {
      clearInterval(timer);
      location.replace(place.dataset.return);
    }
  }, 500);
}
