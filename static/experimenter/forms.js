// Small helps for forms: copying links, asking before something is cut off, and not sending twice.

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
addEventListener("pageshow", () => {
  for (const form of document.querySelectorAll("[data-sent]")) delete form.dataset.sent;
});
