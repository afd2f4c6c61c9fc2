// Small helps for forms: copying links, asking before something is cut off, and not sending twice.

const TYPED = "textarea, select, input:not([type=hidden], [readonly])";
const copied = document.querySelector("[data-copied]");

for (const button of document.querySelectorAll("[data-copy], [data-copy-all]")) {
  button.hidden = false;
  button.addEventListener("click", () => {
    const fields = button.dataset.copy
      ? [document.getElementById(button.dataset.copy)]
      : [...document.querySelectorAll("[data-links] input")];
    copy(fields, button.dataset.copy ? "Copied." : "All links copied.");
  });
}

async function copy(fields, said) {
  const text = fields.map((field) => field.value).join("\n");
  try {
    await navigator.clipboard.writeText(text); // only on HTTPS and localhost
  } catch {
    copyTheOldWay(text);
  }
  copied.textContent = said;
}

function copyTheOldWay(text) {
  const area = document.createElement("textarea");
  area.value = text;
  document.body.append(area);
  area.select();
  document.execCommand("copy");
  area.remove();
}

document.addEventListener("submit", (event) => {
  const form = event.target;
  if (form.dataset.known === undefined && form.method === "post" && form.querySelector(TYPED)) {
    event.preventDefault();
    sendIfKnown(form, event.submitter);
    return;
  }
  const question = event.submitter?.dataset.confirm ?? form.dataset.confirm;
  if (question && !confirm(question)) {
    event.preventDefault();
    return;
  }
  if (form.dataset.once !== undefined) {
    if (form.dataset.sent) event.preventDefault();
    form.dataset.sent = "yes";
  }
});

// A form that is sent when nobody is logged in any more, or to nobody, would be gone with all that was typed.
async function sendIfKnown(form, submitter) {
  const { account, login } = document.querySelector("[data-account]").dataset;
  const headers = { Accept: "application/json", "X-Unattended": "1" };
  const answer = await fetch(account, { headers, signal: AbortSignal.timeout(10000) }).catch(() => null);
  form.querySelector("[data-kept]")?.remove();
  if (answer && answer.status !== 401) {
    form.dataset.known = "yes"; // the next submit event is this one again
    form.requestSubmit(submitter);
    delete form.dataset.known;
    return;
  }
  const notice = document.createElement("div");
  Object.assign(notice, { className: "alert", role: "alert", tabIndex: -1 });
  notice.dataset.kept = "";
  if (answer) {
    const way = document.createElement("a");
    Object.assign(way, { href: login, target: "_blank", textContent: "Log in in another tab" });
    notice.append("You are logged out. What you typed is still here, and not saved. ", way, ", then send it again.");
  } else notice.append("The studio does not answer. What you typed is still here, and not saved. Try again in a moment.");
  form.append(notice);
  notice.focus();
}

addEventListener("pageshow", () => {
  for (const form of document.querySelectorAll("[data-sent]")) delete form.dataset.sent;
});
