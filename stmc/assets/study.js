// A survey: two motions in step above their timeline, two questions a pair. Answers are kept in the browser as they are
// given and saved as a file at the end. Which method made which motion is not in here.

import { find, make, roomStyle } from "./studio/dom.js";
import { bytesOf, figureOf } from "./studio/figure.js";
import { createPlayer } from "./studio/player.js";
import { createStage } from "./studio/stage.js";
import { createTimelineBar, createTransport, playedByKey } from "./studio/transport.js";

const survey = JSON.parse(find("survey").textContent);
const ASPECTS = ["realism", "timeline"];
const SIDES = ["left", "right"];
const NONE = "none";
const REST = 0.7; // seconds for which the last frame stands before the motions start again

// ---- what is kept -------------------------------------------------------------------------------------------------
const place = "stmc-study/" + survey.survey;
let keeps = true;

function recall(name) {
  try {
    return localStorage.getItem(name);
  } catch {
    keeps = false;
    return null;
  }
}

function keep(name, value) {
  try {
    localStorage.setItem(name, value);
  } catch {
    keeps = false;
  }
}

function raterCode() {
  const known = recall("stmc-study/rater");
  if (/^[0-9a-f]{16}$/.test(known || "")) return known;
  const bytes = crypto.getRandomValues(new Uint8Array(8));
  const made = Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
  keep("stmc-study/rater", made);
  return made;
}

function restored() {
  const fresh = { at: -1, answers: {}, seen: {} };
  try {
    const state = Object.assign(fresh, JSON.parse(recall(place)) || {});
    state.at = Math.min(Math.max(Math.trunc(state.at) || 0, -1), survey.questions.length);
    return state;
  } catch {
    return fresh;
  }
}

const rater = raterCode();
const state = restored();
const save = () => keep(place, JSON.stringify(state));

// ---- motions --------------------------------------------------------------------------------------------------
let shown = null; // the question
const duration = () => shown?.duration ?? 0;
const player = createPlayer(duration);
player.rest = REST;
const stage = createStage(find("stage"));
stage.colour(() => [1, 1, 1]); // the figures bring their own
const figures = new Map(); // side and number of a figure → the promise of it

function figureAt(side, number) {
  const key = `${side} ${number}`;
  if (!figures.has(key)) figures.set(key, figureOf(bytesOf(survey.figures[number])));
  return figures.get(key);
}

// Both bodies, of one size and wholly in the picture at any time and from any side.
async function showMotions({ id, clips }) {
  const pair = await Promise.all(clips.map(({ figure }, side) => figureAt(SIDES[side], figure)));
  if (shown?.id !== id) return;
  pair.forEach((figure, side) => figure.choose(clips[side].id));
  const balls = pair.map((figure) => figure.bounds(true));
  const [low, high] = [Math.min(...balls.map(({ height, radius }) => height - radius)), Math.max(...balls.map(({ height, radius }) => height + radius))];
  stage.show(pair.map((figure, side) => ({ key: SIDES[side], figure })), SIDES[0]);
  stage.theme({ ...roomStyle(), way: null });
  stage.aim({ middle: null, height: (low + high) / 2, radius: (high - low) / 2 });
  player.seek(0);
  player.play(true);
}

player.listen((time, playing) => {
  stage.at(time);
  document.body.dataset.time = time.toFixed(3);
  if (!playing || time < duration() || !shown || state.seen[shown.id]) return;
  state.seen[shown.id] = true;
  save();
  tell();
});
const transport = createTransport(player, duration);
const bar = createTimelineBar(find("tracks"), find("ruler"), find("cursor"), player, duration);

// ---- one question -------------------------------------------------------------------------------------------------
function drawTimeline(question) {
  const place = (seconds) => `${(100 * seconds) / question.duration}%`;
  const rows = [];
  for (const { row } of question.prompts) while (rows.length <= row) rows.push(make("div", { class: "track" }));
  const now = question.prompts.map(({ text, start, end, row }) => {
    const times = { "data-from": start, "data-to": end };
    const style = `left:${place(start)};width:${place(end - start)}`;
    rows[row].append(make("div", { class: "bar", title: text, style, ...times }, text));
    return make("span", times, text);
  });
  find("rows").replaceChildren(...rows);
  find("now").replaceChildren(...now);
  const step = [1, 2, 5, 10, 20, 30, 60, 300].find((seconds) => question.duration / seconds <= 16) || 600;
  const count = Math.floor(question.duration / step) + 1;
  find("ruler").replaceChildren(...Array.from({ length: count }, (_, tick) =>
    make("b", { style: `left:${place(tick * step)}` }, tick ? `${tick * step}` : "0 s")));
}

function drawChoices(question) {
  const answers = state.answers[question.id] || {};
  document.querySelectorAll(".choices").forEach((box, row) => {
    const { aspect } = box.dataset;
    const choices = [["Left", question.clips[0].id], ["No preference", NONE], ["Right", question.clips[1].id]];
    box.replaceChildren(...choices.map(([text, value], column) => make("label", {}, text,
      make("input", { type: "radio", name: aspect, value, checked: answers[aspect] === value }), make("kbd", {}, `${3 * row + column + 1}`))));
  });
}

function missing() {
  const question = survey.questions[state.at];
  const answers = state.answers[question.id] || {};
  const open = ASPECTS.filter((aspect) => !answers[aspect]).length;
  if (!state.seen[question.id]) return "Please watch both motions to the end.";
  return open ? `Please answer ${open === 2 ? "both questions" : "the other question, too"}.` : "";
}

function tell() {
  find("missing").textContent = missing();
  find("next").disabled = missing() !== "";
}

function show() {
  const count = survey.questions.length;
  find("welcome").hidden = state.at !== -1;
  find("thanks").hidden = state.at !== count;
  find("ask").hidden = state.at < 0 || state.at >= count;
  document.body.dataset.at = state.at;
  document.activeElement?.blur(); // else a button that is gone would still take the space bar
  shown = survey.questions[state.at] ?? null;
  player.play(false);
  if (!shown) return;
  const question = shown;
  find("number").textContent = `Pair ${state.at + 1} of ${count}`;
  find("progress").value = state.at / count;
  find("next").textContent = state.at + 1 < count ? "Next" : "Finish";
  drawTimeline(question);
  drawChoices(question);
  tell();
  player.seek(0);
  transport.show();
  bar.show();
  showMotions(question).catch((error) => (find("missing").textContent = `The motions cannot be shown: ${error.message}`));
}

function go(step) {
  state.at += step;
  save();
  show();
}

function choose(aspect, value) {
  const question = survey.questions[state.at];
  state.answers[question.id] = Object.assign(state.answers[question.id] || {}, { [aspect]: value });
  save();
  tell();
}

// ---- the file -----------------------------------------------------------------------------------------------------
function answersFile() {
  const answers = {};
  for (const { id } of survey.questions) answers[id] = state.answers[id];
  return JSON.stringify({ format: "stmc study answers 1", survey: survey.survey, rater, answers }, null, 1) + "\n";
}

function download() {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([answersFile()], { type: "application/json" }));
  link.download = `answers_${survey.survey}_${rater}.json`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
  find("file").textContent = link.download;
  find("saved").hidden = false;
}

// ---- what the rater does ------------------------------------------------------------------------------------------
find("start").addEventListener("click", () => go(1));
find("back").addEventListener("click", () => go(-1));
find("change").addEventListener("click", () => go(-1));
find("save").addEventListener("click", download);
find("form").addEventListener("change", (event) => choose(event.target.name, event.target.value));
find("form").addEventListener("submit", (event) => {
  event.preventDefault();
  if (!missing()) go(1);
});

document.addEventListener("keydown", (event) => {
  if (!shown || event.ctrlKey || event.metaKey || event.altKey || event.target.matches("select")) return;
  const digit = /^[1-6]$/.test(event.key) && document.querySelectorAll(".choices input")[Number(event.key) - 1];
  if (digit) digit.click();
  else if (event.key === "Enter" && !event.target.matches("button")) find("next").click();
  else if (!playedByKey(event, player, duration)) return;
  event.preventDefault();
});

for (const element of document.querySelectorAll(".count")) element.textContent = survey.questions.length;
find("code").textContent = rater;
save();
find("forgetful").hidden = keeps;
show();
