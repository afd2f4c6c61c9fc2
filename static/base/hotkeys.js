// A key does what pressing its button does: the buttons say which, by data-key. A key held down does nothing more.

// `scope()` gives the element whose buttons count now; `used(key)` is told of every key that did something.
export function listen(scope, used = () => {}) {
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || belongsToFocus(event)) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const buttons = scope().querySelectorAll(`[data-key="${CSS.escape(key)}"]`);
    const button = [...buttons].find((each) => each.checkVisibility?.() ?? each.offsetParent !== null);
    if (!button) return;
    event.preventDefault();
    if (event.repeat && !button.hasAttribute("data-step")) return;
    used(key);
    button.click();
  });
}

// Keys that the focused element needs itself: arrows on a slider, the space bar on a button reached with Tab.
function belongsToFocus(event) {
  const { target, key } = event;
  if (target.matches?.("input[type=range]")) return key.startsWith("Arrow") || ["Home", "End"].includes(key);
  if (target.matches?.("input, textarea, select")) return true;
  return key === " " && Boolean(target.matches?.("button:focus-visible, a:focus-visible, summary:focus-visible"));
}
