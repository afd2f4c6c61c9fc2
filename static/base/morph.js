// Makes one part of a page look like fresh HTML while touching only what differs, so that focus, opened details and
// what is being typed survive.

export function morph(element, html) {
  const fresh = document.createElement("template");
  fresh.innerHTML = html;
  matchChildren(element, fresh.content);
}

function matchChildren(element, fresh) {
  const keyed = new Map([...element.children].filter((child) => child.dataset?.row).map((child) => [child.dataset.row, child]));
  let place = element.firstChild;
  for (const wanted of [...fresh.childNodes]) {
    const same = wanted.dataset?.row ? keyed.get(wanted.dataset.row) : place;
    if (same && alike(same, wanted)) {
      if (same !== place) element.insertBefore(same, place);
      else place = place.nextSibling;
      matchNode(same, wanted);
    } else {
      element.insertBefore(wanted, place);
    }
  }
  while (place) {
    const next = place.nextSibling;
    place.remove();
    place = next;
  }
}

function alike(one, other) {
  return one.nodeName === other.nodeName && one.dataset?.row === other.dataset?.row;
}

function matchNode(element, wanted) {
  if (element.nodeType !== Node.ELEMENT_NODE) {
    if (element.nodeValue !== wanted.nodeValue) element.nodeValue = wanted.nodeValue;
    return;
  }
  const mine = element.nodeName === "DETAILS" ? ["open"] : []; // the person's choice
  for (const { name } of [...element.attributes]) {
    if (!wanted.hasAttribute(name) && !mine.includes(name)) element.removeAttribute(name);
  }
  for (const { name, value } of wanted.attributes) {
    if (element.getAttribute(name) !== value && !mine.includes(name)) element.setAttribute(name, value);
  }
  matchChildren(element, wanted);
}
