// Live: a stream plays the timeline while it is edited. Reads frames ahead of the cursor, and makes each difference between
// the document and what the stream has an edit of the stream. Knows the server's streams and the player.

import * as server from "./server.js";
import { button, find, say, watch } from "./dom.js";
import { streamedFigure } from "./live_figure.js";
import { PARTS, SHORTEST, promptOf, rounded, settled, timelineOf } from "./state.js";

const AHEAD = 1.5; // seconds that are read ahead of the cursor
const FRAMES = 10; // of each request
const MOST_EDITS = 20; // of each request, as the server takes them
const LOOK_AFTER = 50; // milliseconds
const AGAIN_AFTER = 1000; // where the server is away

const sleep = (delay) => new Promise((resolve) => setTimeout(resolve, delay));
const sameText = (one, other) => one.text === other.text && one.parts.join() === other.parts.join();
const sameTimes = (one, other) => one.start === other.start && one.end === other.end;
const partsOf = (parts) => (parts.length ? { body_parts: parts } : {}); // none: the server suggests some
const addOf = ({ text, start, end, parts }) => ({ add: { text, start, end, ...partsOf(parts) } });

// What makes the prompts of a stream those of a document: [{edit, id, prompt, replaces}]. `streamed`: by ids, the number and
// the prompt that the stream has; `begun(prompt)`: whether it starts before the stream's next frame.
export function editsOf(prompts, streamed, begun) {
  const edits = [];
  for (const prompt of prompts) {
    const { id, start, end } = prompt;
    const { number, prompt: before } = streamed.get(id) ?? {};
    if (before && sameText(before, prompt)) {
      if (!sameTimes(before, prompt)) edits.push({ edit: { move: number, start, end }, id, prompt });
      continue;
    }
    if (before && !begun(prompt)) edits.push({ edit: { remove: number }, id, replaces: true });
    edits.push({ edit: addOf(prompt), id, prompt }); // refused where it has begun, so that the old one stays
  }
  for (const [id, { number }] of streamed)
    if (!prompts.some((prompt) => prompt.id === id)) edits.push({ edit: { remove: number }, id, prompt: null });
  return edits;
}

export function createLive(studio, player, stage, work) {
  const { store } = studio;
  let stream = null; // {name, document, fps, streamed, figure, count (of frames), seconds, ended, before}
  let waiting = []; // prompts that are typed: {text, seconds, parts}

  async function start() {
    if (store.get().live) return;
    const { id, history } = store.get();
    const document = history.present;
    const mine = (stream = { name: null, document: id, streamed: new Map(), count: 0, seconds: 0, ended: false, before: settled(history) });
    waiting = [];
    store.set({ live: { seconds: 0 }, pulling: false, drawing: false, span: null });
    work.cancel();
    player.waits = true;
    player.seek(0);
    player.play(true);
    try {
      const timeline = document.prompts.length ? timelineOf(document) : null;
      const opened = await server.openStream({ ...document.settings, timeline, seed: document.seeds[0] });
      Object.assign(mine, { name: opened.stream, fps: opened.fps });
      document.prompts.forEach((prompt, index) => mine.streamed.set(prompt.id, { number: opened.prompts[index].number, prompt }));
      mine.figure = await streamedFigure(await server.mannequinFile(), opened);
    } catch (error) {
      if (stream === mine) return stop(error.message);
    }
    if (stream === mine) follow(mine);
    else close(mine); // it was stopped meanwhile
  }

  function stop(sentence = null) {
    if (sentence) say(sentence);
    store.set({ live: null });
  }

  // However Live ends: by its button, with another document, or with the stream.
  function finish() {
    const mine = stream;
    stream = null;
    player.play(false);
    player.waits = false;
    stage.show([], null);
    close(mine);
    const { id, auto, quality } = store.get();
    if (id !== mine.document) return;
    studio.collapse(mine.before);
    player.seek(Math.min(player.time(), studio.duration()));
    const document = studio.present();
    if (auto && document.prompts.length && !studio.knows(document, quality)) work.generate();
  }

  function close({ name, figure }) {
    figure?.dispose();
    if (name) server.closeStream(name).catch(() => {}); // it may have ended meanwhile
  }

  // ---- frames -----------------------------------------------------------------------------------------------------------
  async function follow(mine) {
    while (stream === mine) {
      const edits = editsNow(mine);
      const ahead = mine.seconds - Math.min(player.time(), mine.seconds);
      const frames = !mine.ended && ahead < AHEAD * Math.max(player.speed, 1) ? FRAMES : 0;
      if (!edits.length && !frames) await sleep(LOOK_AFTER);
      else await read(mine, edits, frames);
    }
  }

  async function read(mine, edits, frames) {
    let answer = null;
    try {
      answer = await server.readStream(mine.name, edits.map(({ edit }) => edit), frames);
    } catch (error) {
      if (stream !== mine) return;
      if (error.status !== 0) return stop(error.message);
      say("The server does not answer; trying again.");
      waiting = [...edits.flatMap(({ next }) => next ?? []), ...waiting];
      await sleep(AGAIN_AFTER);
    }
    if (answer && stream === mine) take(mine, edits, answer);
  }

  function take(mine, edits, { answers, frames, prompts, ended }) {
    const first = !mine.seconds && frames.length;
    mine.figure.add(frames);
    takeAnswers(mine, edits, answers);
    mine.count += frames.length;
    mine.seconds = mine.count / mine.fps;
    mine.ended = ended;
    store.set({ live: { seconds: mine.seconds } });
    if (first) stage.show([{ key: "live", figure: mine.figure }], "live");
    stage.refresh();
    document.body.dataset.live = JSON.stringify({ seconds: mine.seconds, prompts: prompts.map(({ text }) => text) });
  }

  // ---- edits ------------------------------------------------------------------------------------------------------------
  function editsNow(mine) {
    const { history } = store.get();
    const begun = ({ start }) => Math.floor(start * mine.fps + 1e-6) < mine.count;
    const changed = history.gesture === null ? editsOf(history.present.prompts, mine.streamed, begun) : [];
    const typed = waiting.map((next) => ({ edit: { add: { text: next.text, seconds: next.seconds, ...partsOf(next.parts) } }, next }));
    const edits = [...typed, ...changed].slice(0, MOST_EDITS);
    waiting = waiting.slice(edits.filter(({ next }) => next).length);
    return edits;
  }

  // The document follows where the stream has refused an edit, or ended a prompt that had begun.
  function takeAnswers(mine, edits, answers) {
    const [restored, without] = [[], []];
    answers.forEach((answer, index) => {
      const { id, prompt, next, replaces } = edits[index];
      const before = mine.streamed.get(id)?.prompt;
      const asItWas = !next && promptOf(studio.present(), id) === (prompt ?? null); // or it was edited again meanwhile
      if (answer.error) {
        say(server.sentence(answer.error));
        if (asItWas && before) restored.push(before);
        else if (asItWas) without.push(id);
      } else if (next) write(mine, next, answer);
      else if (prompt) mine.streamed.set(id, { number: answer.added ?? answer.moved, prompt });
      else if (replaces || before.start * mine.fps >= answer.frame) mine.streamed.delete(id);
      else {
        const played = { ...before, end: rounded(Math.max(answer.frame / mine.fps, before.start + SHORTEST)) };
        mine.streamed.set(id, { number: answer.removed, prompt: played });
        if (asItWas) restored.push(played);
      }
    });
    if (restored.length || without.length) studio.edit({ kind: "follow", prompts: restored, without });
  }

  // A prompt that was typed stands beneath those of its time: the last one has the body parts, as in the stream.
  function write(mine, { text, parts }, { added: number, start, end }) {
    const { prompts, next } = studio.present();
    const tracks = prompts.filter((other) => other.start < end && start < other.end).map(({ track }) => track);
    studio.edit({ kind: "add", text, start, end, parts, track: Math.max(-1, ...tracks) + 1 });
    mine.streamed.set(`p${next}`, { number, prompt: promptOf(studio.present(), `p${next}`) });
  }

  // ---- the page ---------------------------------------------------------------------------------------------------------
  const [text, seconds, chips] = ["next-text", "next-seconds", "next-parts"].map(find);
  const chosen = () => PARTS.filter((_, index) => chips.children[index].getAttribute("aria-pressed") === "true");
  const choose = ({ currentTarget: chip }) => {
    const on = chip.getAttribute("aria-pressed") !== "true";
    chip.setAttribute("aria-pressed", String(on));
    chip.classList.toggle("on", on);
  };
  chips.append(...PARTS.map((part) => button(part, choose, { class: "chip", "aria-pressed": "false" })));

  function next(typed, parts = chosen()) {
    const words = typed.trim();
    if (words) waiting.push({ text: words, seconds: Math.max(SHORTEST, seconds.valueAsNumber || 3), parts });
  }

  text.onkeydown = (event) => {
    if (event.key !== "Enter" || event.isComposing) return;
    event.preventDefault();
    next(text.value);
    text.value = "";
  };
  const toggle = () => (store.get().live ? stop() : start());
  find("live").onclick = toggle;
  addEventListener("pagehide", () => stream?.name && server.closeStream(stream.name).catch(() => {}));

  player.listen((time, playing) => {
    const dry = stream !== null && playing && time >= stream.seconds;
    find("buffering").hidden = !dry || stream.ended;
    if (dry && stream.ended) stop(`The stream has come to its end at ${stream.seconds} s; its prompts stay in the timeline.`);
  });
  watch(store, ({ live }) => [live !== null], ({ live }) => {
    find("live").setAttribute("aria-pressed", String(live !== null));
    find("next").hidden = live === null;
    if (live) return text.focus({ preventScroll: true });
    find("buffering").hidden = true;
    delete document.body.dataset.live;
    if (stream) finish();
  });

  return { toggle, stop, next, focus: () => text.focus() };
}
