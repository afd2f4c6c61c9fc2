// The labelling page: plays a pair, takes one answer, shows the next pair. An answer is stored on the server before
// anything on the page says so.

import { keepOnly, makeVideo, preload } from "./clips.js";
import { LockStep } from "./lock_step.js";
import { Outbox } from "./outbox.js";

const SETTLE_MS = 200; // a press this soon after a new pair appeared was meant for the one before

const page = document.querySelector("[data-pair]");
const find = (name) => page.querySelector(`[data-${name}]`);
const answers = find("answers");
const undo = find("undo");
const buttons = [...answers.querySelectorAll("button")];
const still = matchMedia("(prefers-reduced-motion: reduce)");
const outbox = new Outbox(page.dataset.who);

let turn = JSON.parse(page.dataset.turn);
let prepared = null; // { query_id, videos: promise of both } of the pair after this one
let player = null;
let watching = null; // what is measured about this pair
let phase = "loading"; // loading, ready, unplayable, saving

start();

async function start() {
  find("replay").hidden = false;
  answers.addEventListener("submit", (event) => {
    event.preventDefault();
    answer(event.submitter);
  });
  undo.addEventListener("submit", (event) => {
    event.preventDefault();
    takeBack();
  });
  find("replay").addEventListener("click", replay);
  addEventListener("keydown", press);
  addEventListener("pageshow", (event) => event.persisted && location.reload());

  const [earlier] = outbox.pending();
  if (earlier) {
    setPhase("saving");
    say("Saving an earlier answer …");
    await send(earlier, null);
  } else {
    await show([...page.querySelectorAll("video")]);
  }
}

// --- showing ---------------------------------------------------------------------------------------------------------

async function show(videos) {
  const { pair, following } = turn;
  watching = { firstFrameAt: null, replays: 0, playErrors: watching?.queryId === pair.query_id ? watching.playErrors : 0, queryId: pair.query_id };
  setPhase("loading");
  clearNotice();
  player?.stop();
  player = new LockStep(...videos, pair.fps, {
    firstFrame: () => {
      watching.firstFrameAt = performance.now();
      setTimeout(() => watching.queryId === pair.query_id && phase === "loading" && setPhase("ready"), SETTLE_MS);
    },
    trouble: unplayable,
    gestureNeeded: playOnDemand,
    roundEnded: () => still.matches && playOnDemand("Play again"),
  });
  if (still.matches) {
    if (await player.ready()) playOnDemand();
    else unplayable();
  } else {
    player.play({ loop: true });
  }
  prepare(following);
}

// Loads the pair after this one into memory, down to its video elements.
function prepare(pair) {
  keepOnly([turn.pair, pair].flatMap((each) => (each ? [each.left.video, each.right.video] : [])));
  if (!pair) return;
  for (const path of [pair.left.video, pair.right.video]) preload(path).catch(() => {});
  prepared = { queryId: pair.query_id, videos: videosOf(pair) };
}

function videosOf(pair) {
  const make = (clip, label) => makeVideo(clip, label, pair.width, pair.height);
  return Promise.all([make(pair.left, "Left clip"), make(pair.right, "Right clip")]);
}

async function go(next) {
  turn = next;
  if (turn.state !== "pair") {
    location.replace(turn.state === "finished" ? page.dataset.finishedPath : page.dataset.waitingPath);
    return;
  }
  const videos = await (prepared?.queryId === turn.pair.query_id ? prepared.videos : videosOf(turn.pair));
  prepared = null;
  player?.stop();
  page.querySelectorAll("figure").forEach((figure, index) => {
    const old = figure.querySelector("video");
    old.replaceWith(videos[index]);
    old.removeAttribute("src");
    old.load();
    delete figure.dataset.chosen;
  });
  answers.action = turn.pair.label_path;
  undo.hidden = !turn.undo_path;
  undo.action = turn.undo_path ?? "";
  const progress = find("progress");
  progress.max = turn.wanted;
  progress.value = turn.answered;
  find("count").textContent = `${turn.answered} of ${turn.wanted}`;
  find("time-left").textContent = turn.time_left ? `${turn.time_left} left` : "";
  await show(videos);
}

// --- answering -------------------------------------------------------------------------------------------------------

async function answer(button) {
  if (phase !== "ready" && !(phase === "unplayable" && button.value === "skip")) return;
  const elapsed = watching.firstFrameAt === null ? "" : Math.round(performance.now() - watching.firstFrameAt);
  const entry = outbox.add(turn.pair.label_path, {
    response: button.value,
    response_time_ms: elapsed,
    replay_count: watching.replays,
    play_error_count: watching.playErrors,
  });
  page.querySelector(`figure[data-side="${button.value}"]`)?.setAttribute("data-chosen", "");
  await send(entry, button);
}

async function takeBack() {
  if (phase === "saving" || !turn.undo_path) return;
  await send(outbox.add(turn.undo_path, {}), undo.querySelector("button"));
}

async function send(entry, button) {
  setPhase("saving");
  button?.setAttribute("data-pressed", "");
  const slow = setTimeout(() => say("Saving …"), 600);
  try {
    const next = await outbox.deliver(entry, () => {
      clearTimeout(slow);
      say("Not saved yet. Trying again …", "trouble");
    });
    say(entry.fields.response ? `Saved. ${next.answered} of ${next.wanted}.` : "Taken back. Please answer again.");
    await go(next);
  } catch (refused) {
    const again = refused.status !== 401;
    notice(refused.message, again ? "Go on" : "Try again", () => location.reload());
    say("");
  } finally {
    clearTimeout(slow);
    button?.removeAttribute("data-pressed");
  }
}

function replay() {
  if (phase === "saving" || phase === "unplayable") return;
  if (watching.firstFrameAt !== null) watching.replays += 1;
  clearNotice();
  player.play({ loop: !still.matches });
}

// A key does what pressing its button does; a key held down does nothing more.
function press(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const button = page.querySelector(`[data-key="${CSS.escape(key)}"]`);
  if (!button) return;
  event.preventDefault();
  if (!event.repeat && !button.closest("[hidden]")) button.click();
}

// --- saying ----------------------------------------------------------------------------------------------------------

function setPhase(now) {
  phase = now;
  page.dataset.phase = now;
  for (const button of buttons) {
    const usable = now === "ready" || (now === "unplayable" && button.value === "skip");
    button.setAttribute("aria-disabled", String(!usable));
  }
}

function say(text, kind = "") {
  const status = find("status");
  status.textContent = text;
  status.dataset.kind = kind;
}

function unplayable() {
  if (phase === "saving") return;
  watching.playErrors += 1;
  setPhase("unplayable");
  notice("These clips could not be loaded.", "Load them again", async () => {
    keepOnly([]);
    const videos = await videosOf(turn.pair);
    page.querySelectorAll("figure video").forEach((old, index) => old.replaceWith(videos[index]));
    await show(videos);
  });
}

function playOnDemand(text = "Play both") {
  notice("", text, () => {
    if (watching.firstFrameAt === null) {
      clearNotice();
      player.play({ loop: !still.matches });
    } else {
      replay();
    }
  });
}

function notice(text, buttonText, act) {
  find("notice-text").textContent = text;
  const button = find("notice-button");
  button.textContent = buttonText;
  button.onclick = act;
  find("notice").hidden = false;
}

function clearNotice() {
  find("notice").hidden = true;
}
