// Sends answers until the server has them. Each answer gets its UUID once, is kept in the browser's storage until it is
// acknowledged, and is always sent with that UUID, so that however often it arrives it counts once.

const PREFIX = "studio.outbox.";
const FIRST_WAIT_MS = 1000;
const LONGEST_WAIT_MS = 10000;
const TIMEOUT_MS = 10000;

export class Refused extends Error {
  constructor(status, detail) {
    super(detail);
    this.status = status;
  }
}

export class Outbox {
  // `who` keeps the answers of several participants on one computer apart.
  constructor(who) {
    this.who = who;
  }

  // Entries of earlier visits that were never acknowledged, oldest first.
  pending() {
    return Object.keys(localStorageOrNothing())
      .filter((key) => key.startsWith(PREFIX))
      .map((key) => read(key))
      .filter((entry) => entry && entry.who === this.who)
      .sort((one, other) => one.at - other.at);
  }

  // Keeps the fields to be posted to this path; returns the entry to deliver.
  add(path, fields) {
    const entry = { path, fields: { ...fields, client_uuid: newUuid() }, who: this.who, at: Date.now() };
    write(entry);
    return entry;
  }

  // Resolves with the server's answer, however long that takes. `onWaiting` is called before each further attempt.
  // Rejects with Refused when the server will never take it.
  async deliver(entry, onWaiting) {
    for (let wait = FIRST_WAIT_MS; ; wait = Math.min(2 * wait, LONGEST_WAIT_MS)) {
      const response = await post(entry).catch(() => null);
      const body = response && (await response.json().catch(() => null));
      if (response?.ok && body) {
        remove(entry);
        return body;
      }
      if (response && response.status >= 400 && response.status < 500 && response.status !== 429) {
        if (response.status !== 401) remove(entry);
        throw new Refused(response.status, body?.detail ?? "The server did not accept this answer.");
      }
      onWaiting();
      await pause(wait);
    }
  }
}

function post(entry) {
  return fetch(entry.path, {
    method: "POST",
    headers: { Accept: "application/json" },
    body: new URLSearchParams(entry.fields),
    redirect: "error",
    signal: AbortSignal.timeout(TIMEOUT_MS),
  });
}

// A while, or until the network is back.
function pause(milliseconds) {
  return new Promise((resolve) => {
    const done = () => {
      clearTimeout(timer);
      removeEventListener("online", done);
      resolve();
    };
    const timer = setTimeout(done, milliseconds);
    addEventListener("online", done);
  });
}

// crypto.randomUUID exists only on HTTPS and localhost; laboratories often have neither.
export function newUuid() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  bytes[6] = (bytes[6] & 0x0f) | 0x40;
  bytes[8] = (bytes[8] & 0x3f) | 0x80;
  const hex = Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
  return [hex.slice(0, 8), hex.slice(8, 12), hex.slice(12, 16), hex.slice(16, 20), hex.slice(20)].join("-");
}

// Storage may be forbidden (private windows); then an answer lives as long as its page.
function localStorageOrNothing() {
  try {
    return localStorage;
  } catch {
    return {};
  }
}

function read(key) {
  try {
    return JSON.parse(localStorage.getItem(key));
  } catch {
    return null;
  }
}

function write(entry) {
  try {
    localStorage.setItem(PREFIX + entry.fields.client_uuid, JSON.stringify(entry));
  } catch {
    // see above
  }
}

function remove(entry) {
  try {
    localStorage.removeItem(PREFIX + entry.fields.client_uuid);
  } catch {
    // see above
  }
}
