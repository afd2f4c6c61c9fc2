// The labelling page: plays a pair, takes one answer, shows the next pair. An answer is stored on the server before
// anything on the page says so. Practice is the same page with a strip that explains the keys.

import { keepOnly, makeVideo, preload } from "./clips.js";
import { Enlarging } from "./enlarging.js";
import { Events } from "./events.js";
import { listen } from "../base/hotkeys.js";
import { LockStep } from "../base/lock_step.js";
import { Outbox } from "./outbox.js";
import { PlayerControls } from "../base/player_controls.js";
import { Practice } from "./practice.js";

const SETTLE_MS = 200; // a press this soon after a new pair appeared was meant for the one before

const page = document.querySelector("[data-pair]");
const find = (name) => page.querySelector(`[data-${name}]`);
const words = Object.fromEntries(
  Object.entries(page.dataset)
    .filter(([name]) => name.startsWith("say"))
    .map(([name, text]) => [name[3].toLowerCase() + name.slice(4), text]),
);
const answers = find("answers");
const undo = find("undo");
const why = find("why"); // only where "can't tell" is an answer
const mattered = find("mattered"); // only where the study asks what made the difference
const written = answers.querySelector("[data-written]"); // a reason in words, where the study asks for it
const buttons = [...answers.querySelectorAll("button")];
const still = matchMedia("(prefers-reduced-motion: reduce)");
const watchFirst = page.dataset.watchFirst === "yes";
const outbox = new Outbox(page.dataset.who);
const events = new Events(page.dataset.eventsPath);

let turn = JSON.parse(page.dataset.turn);
let prepared = null; // { queryId, videos: promise of both } of the pair after this one
let player = null;
let watching = null; // what is measured about this pair
let phase = "loading"; // loading, watching, ready, unplayable, saving
let pressed = null; // { response, elapsed, button } of the button that was pressed, while a dialog asks for more

const practice = find("practice") && new Practice(find("practice"), say, (count) => events.note("keys_used", { count }));
const enlarging = new Enlarging(page);
const controls = new PlayerControls(find("player"), () => player, words, {
  scrubbed: () => watching && (watching.scrubs += 1),
  used: (name) => practice?.used(name),
});

start();

async function start() {
  find("late").remove();
  find("replay").hidden = false;
  for (const button of [...buttons, undo.querySelector("button")]) button.disabled = false; // aria-disabled tells from here on
  answers.addEventListener("submit", (event) => {
    event.preventDefault();
    answer(event.submitter);
  });
  undo.addEventListener("submit", (event) => {
    event.preventDefault();
    takeBack();
  });
  find("replay").addEventListener("click", replay);
  why?.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    why.close();
    if (button.dataset.reason !== undefined) give(pressed, { reason: button.dataset.reason });
  });
  mattered?.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    mattered.close();
    if (button.dataset.quality !== undefined) give(pressed, { quality: button.dataset.quality });
  });
  listen(() => [why, mattered].find((dialog) => dialog?.open) ?? page);
  addEventListener("pageshow", (event) => event.persisted && location.reload());
  events.watchVisibility(() => ({ query_id: watching?.queryId ?? "" }));

  const [earlier] = outbox.pending();
  if (earlier) {
    setPhase("saving");
    say(words.savingEarlier);
    await send(earlier, null);
  } else {
    await show([...page.querySelectorAll("video")]);
  }
}

// --- showing ---------------------------------------------------------------------------------------------------------

async function show(videos) {
  const { pair, following } = turn;
  const again = watching?.queryId === pair.query_id;
  watching = {
    queryId: pair.query_id,
    firstFrameAt: null,
    replays: again ? watching.replays : 0,
    scrubs: again ? watching.scrubs : 0,
    playErrors: again ? watching.playErrors : 0,
    open: !watchFirst || (again && watching.open),
  };
  const mine = (act) => () => watching.queryId === pair.query_id && act();
  setPhase("loading");
  clearNotice();
  player?.stop();
  player = new LockStep(...videos, pair.fps, {
    firstFrame: () => {
      watching.firstFrameAt = performance.now();
      setTimeout(mine(offerAnswers), SETTLE_MS);
    },
    seenOnce: () => {
      watching.open = true;
      mine(offerAnswers)();
    },
    trouble: unplayable,
    gestureNeeded: playOnDemand,
    roundEnded: () => still.matches && playOnDemand(words.playAgain),
    position: (now, total) => controls.showPosition(now, total),
    playing: (is) => {
      controls.showPlaying(is);
      if (is) clearNotice();
    },
    stalled: (lasted) => events.note("stalled", { query_id: pair.query_id, duration_ms: lasted }),
  });
  player.setRate(controls.rate);
  controls.showPosition(0, 1);
  if (still.matches) {
    player.loop = false;
    if (await player.ready()) playOnDemand();
    else unplayable();
  } else {
    player.play({ loop: true });
  }
  prepare(following);
}

// Loads the pairs after this one into memory, the next of them down to its video elements.
function prepare(following) {
  keepOnly([turn.pair, ...following].flatMap((each) => [each.left.video, each.right.video]));
  for (const pair of following) {
    for (const path of [pair.left.video, pair.right.video]) preload(path).catch(() => {});
  }
  const [next] = following;
  if (next && prepared?.queryId !== next.query_id) prepared = { queryId: next.query_id, videos: videosOf(next) };
}

function videosOf(pair) {
  const make = (clip, label) => makeVideo(clip, label, pair.width, pair.height);
  return Promise.all([make(pair.left, words.leftClip), make(pair.right, words.rightClip)]);
}

async function go(next) {
  if (next.state !== "pair" || next.practising !== turn.practising) {
    location.replace(next.next_path ?? page.dataset.nextPath);
    return;
  }
  if (page.hasAttribute("data-changing")) {
    location.replace(page.dataset.nextPath); // back from an answer that was changed
    return;
  }
  turn = next;
  const videos = await (prepared?.queryId === turn.pair.query_id ? prepared.videos : videosOf(turn.pair));
  prepared = null;
  player?.stop();
  enlarging.show(null);
  page.querySelectorAll("figure").forEach((figure, index) => {
    const old = figure.querySelector("video");
    old.replaceWith(videos[index]);
    old.removeAttribute("src");
    old.load();
    delete figure.dataset.chosen;
  });
  answers.action = turn.pair.label_path;
  if (written) written.value = "";
  undo.hidden = !turn.undo_path;
  undo.action = turn.undo_path ?? "";
  const progress = find("progress");
  progress.max = Math.max(1, turn.wanted);
  progress.value = turn.answered;
  find("count").textContent = filled(words.count, turn);
  find("time-left").textContent = turn.time_left ? words.timeLeft.replace("{time}", turn.time_left) : "";
  await show(videos);
}

// --- answering -------------------------------------------------------------------------------------------------------

function offerAnswers() {
  if (phase !== "loading" && phase !== "watching") return;
  if (watching.open) {
    if (phase === "watching") say(words.nowAnswer);
    setPhase("ready");
  } else {
    setPhase("watching");
    say(words.watchFirst);
  }
}

function usable(response) {
  return phase === "ready" || (phase === "unplayable" && (response === "skip" || watching.firstFrameAt !== null));
}

async function answer(button) {
  practice?.used("answer");
  if (!usable(button.value)) return;
  const elapsed = watching.firstFrameAt === null ? "" : Math.round(performance.now() - watching.firstFrameAt);
  pressed = { response: button.value, elapsed, button };
  if (button.value !== "skip" && (!mattered || button.value === "equal")) {
    await give(pressed);
  } else if (button.value !== "skip") {
    mattered.showModal();
  } else if (watching.firstFrameAt === null) {
    await give(pressed, { reason: "not_seen" });
  } else {
    why.showModal();
  }
}

async function give({ response, elapsed, button }, { reason = "", quality = "" } = {}) {
  if (!usable(response)) return;
  const [leftWatchedMs, rightWatchedMs] = player.watchedMs;
  const entry = outbox.add(turn.pair.label_path, {
    response,
    reason: written ? written.value : reason,
    mattered: quality,
    response_time_ms: elapsed,
    replay_count: watching.replays,
    play_error_count: watching.playErrors,
    stall_count: player.stalls,
    stalled_ms: player.stalledMs,
    largest_drift_ms: player.largestDriftMs,
    playback_rate: controls.rate,
    scrub_count: watching.scrubs,
    watched_whole: player.seenWhole,
    left_watched_ms: leftWatchedMs,
    right_watched_ms: rightWatchedMs,
  });
  page.querySelector(`figure[data-side="${response}"]`)?.setAttribute("data-chosen", "");
  await send(entry, button);
}

async function takeBack() {
  if (phase === "saving" || !turn.undo_path) return;
  if (undo.method === "get") {
    location.assign(turn.undo_path); // the answer stays until there is another
    return;
  }
  await send(outbox.add(turn.undo_path, {}), undo.querySelector("button"));
}

async function send(entry, button) {
  setPhase("saving");
  button?.setAttribute("data-pressed", "");
  const slow = setTimeout(() => say(words.saving), 600);
  try {
    const next = await outbox.deliver(entry, () => {
      clearTimeout(slow);
      say(words.notSaved, "trouble");
    });
    say(entry.fields.response ? filled(words.saved, next) : words.takenBack);
    await go(next);
  } catch (refused) {
    const again = refused.status !== 401;
    notice(refused.message, again ? words.goOn : words.tryAgain, () => location.reload());
    say("");
  } finally {
    clearTimeout(slow);
    button?.removeAttribute("data-pressed");
  }
}

function replay() {
  if (phase === "saving" || phase === "unplayable") return;
  practice?.used("replay");
  if (watching.firstFrameAt !== null) watching.replays += 1;
  clearNotice();
  player.play({ loop: !still.matches });
}

// --- saying ----------------------------------------------------------------------------------------------------------

function setPhase(now) {
  phase = now;
  page.dataset.phase = now;
  for (const button of buttons) button.setAttribute("aria-disabled", String(!usable(button.value)));
}

function say(text, kind = "") {
  const status = find("status");
  status.textContent = text;
  status.dataset.kind = kind;
}

function filled(text, { answered, wanted }) {
  return text.replace("{answered}", answered).replace("{wanted}", wanted);
}

// Whoever has seen something may answer now, whatever the study wants to be seen: nobody is stuck.
function unplayable() {
  if (phase === "saving") return;
  const seen = watching.firstFrameAt !== null;
  watching.playErrors += 1;
  events.note("play_error", { query_id: watching.queryId });
  if (seen && !watching.open) events.note("answers_opened", { query_id: watching.queryId });
  watching.open ||= seen;
  controls.showPlaying(false);
  setPhase("unplayable");
  notice(seen ? words.brokenOff : words.unplayable, words.loadAgain, async () => {
    keepOnly([]);
    prepared = null; // it may have failed as well
    const next = await nextTurn();
    if (next && (next.state !== "pair" || next.pair.query_id !== turn.pair.query_id)) {
      await go(next); // the server passes over pairs whose files are damaged
      return;
    }
    const videos = await videosOf(turn.pair);
    page.querySelectorAll("figure video").forEach((old, index) => old.replaceWith(videos[index]));
    await show(videos);
  });
}

async function nextTurn() {
  const response = await fetch(page.dataset.nextPath, { headers: { Accept: "application/json" } }).catch(() => null);
  return response?.ok && response.headers.get("content-type")?.includes("json") ? response.json() : null;
}

function playOnDemand(text = words.playBoth) {
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
