// Tells the server what happened besides answers, without waiting for it: also while the page goes away.

export class Events {
  constructor(path) {
    this.path = path;
  }

  note(kind, detail = {}) {
    if (!this.path) return; // events are about pairs, and this page shows others
    const body = new URLSearchParams({ kind, ...detail });
    if (!navigator.sendBeacon?.(this.path, body)) {
      fetch(this.path, { method: "POST", body, keepalive: true }).catch(() => {});
    }
  }

  // When the page goes into the background and for how long; `what()` gives more to note.
  watchVisibility(what) {
    let hiddenAt = null;
    document.addEventListener("visibilitychange", () => {
      if (document.hidden) {
        hiddenAt = performance.now();
        this.note("page_hidden", what());
      } else if (hiddenAt !== null) {
        this.note("page_shown", { ...what(), duration_ms: Math.round(performance.now() - hiddenAt) });
        hiddenAt = null;
      }
    });
  }
}
