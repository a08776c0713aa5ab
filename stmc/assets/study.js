// A survey: two motions in step above their timeline, two questions a pair. Answers are kept in the browser as they are
// given and saved as a file at the end. Which method made which motion is not in here.
(() => {
  "use strict";
  const find = (id) => document.getElementById(id);
  const survey = JSON.parse(find("survey").textContent);
  const ASPECTS = ["realism", "timeline"];
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

  const canvases = [find("left"), find("right")];
  const { decoded, ball, draw, view } = stage(survey.tree.length, canvases);

  // ---- time ---------------------------------------------------------------------------------------------------------
  let shown = null; // the question with its decoded clips and its ball
  let time = 0;
  let playing = false;
  let before = null;
  let drawn = ""; // what the pictures show, so that a pause costs nothing

  function seek(value) {
    time = Math.min(Math.max(value, 0), shown.duration);
  }

  function play(on) {
    playing = on;
    find("play").textContent = on ? "❚❚ Pause" : "▶ Play";
  }

  function tick(now) {
    requestAnimationFrame(tick);
    const passed = before === null ? 0 : Math.min((now - before) / 1000, 0.25);
    before = now;
    if (!shown) return;
    if (playing) {
      time += passed * Number(find("speed").value);
      if (time >= shown.duration && !state.seen[shown.id]) {
        state.seen[shown.id] = true;
        save();
        tell();
      }
      if (time > shown.duration + REST) time = 0;
    }
    const at = Math.min(time, shown.duration);
    const sizes = canvases.flatMap((canvas) => [canvas.clientWidth, canvas.clientHeight]);
    const looks = [shown.id, at, view.azimuth, view.elevation, window.devicePixelRatio, ...sizes].join();
    if (looks === drawn) return;
    drawn = looks;
    canvases.forEach((canvas, side) => draw(canvas, shown.clips[side], shown.ball, at));
    mark(at);
  }

  function mark(at) {
    document.body.dataset.time = at.toFixed(3);
    find("scrub").value = at;
    find("time").textContent = at.toFixed(1) + " / " + shown.duration.toFixed(1) + " s";
    find("cursor").style.left = (100 * at) / shown.duration + "%";
    for (const element of document.querySelectorAll("[data-from]")) {
      const now = Number(element.dataset.from) <= at && at < Number(element.dataset.to);
      if (element.classList.contains("bar")) element.classList.toggle("now", now);
      else element.hidden = !now;
    }
  }

  // ---- one question -------------------------------------------------------------------------------------------------
  function made(kind, name, text, parent) {
    const element = document.createElement(kind);
    if (name) element.className = name;
    element.textContent = text;
    parent.append(element);
    return element;
  }

  function drawTimeline(question) {
    const tracks = find("tracks"), now = find("now");
    tracks.textContent = now.textContent = "";
    const rows = [];
    for (const prompt of question.prompts) {
      while (rows.length <= prompt.row) rows.push(made("div", "track", "", tracks));
      const bar = made("div", "bar", prompt.text, rows[prompt.row]);
      bar.title = prompt.text;
      bar.style.left = (100 * prompt.start) / question.duration + "%";
      bar.style.width = (100 * (prompt.end - prompt.start)) / question.duration + "%";
      for (const element of [bar, made("span", "", prompt.text, now)]) {
        element.dataset.from = prompt.start;
        element.dataset.to = prompt.end;
      }
    }
    const ruler = made("div", "", "", tracks);
    ruler.id = "ruler";
    const step = [1, 2, 5, 10, 20, 30, 60, 300].find((seconds) => question.duration / seconds <= 16) || 600;
    for (let second = 0; second <= question.duration; second += step)
      made("b", "", second + (second ? "" : " s"), ruler).style.left = (100 * second) / question.duration + "%";
    made("div", "", "", tracks).id = "cursor";
  }

  function drawChoices(question) {
    const answers = state.answers[question.id] || {};
    document.querySelectorAll(".choices").forEach((box, row) => {
      box.textContent = "";
      const aspect = box.dataset.aspect;
      [["Left", question.clips[0].id], ["No preference", NONE], ["Right", question.clips[1].id]].forEach(([text, value], column) => {
        const label = made("label", "", text, box);
        const input = made("input", "", "", label);
        Object.assign(input, { type: "radio", name: aspect, value, checked: answers[aspect] === value });
        made("kbd", "", 3 * row + column + 1, label);
      });
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
    shown = null;
    drawn = "";
    if (find("ask").hidden) return;
    const question = survey.questions[state.at];
    const clips = question.clips.map(decoded);
    find("number").textContent = `Pair ${state.at + 1} of ${count}`;
    find("progress").value = state.at / count;
    find("next").textContent = state.at + 1 < count ? "Next" : "Finish";
    find("scrub").max = question.duration;
    drawTimeline(question);
    drawChoices(question);
    tell();
    shown = { id: question.id, duration: question.duration, clips, ball: ball(clips) };
    time = 0;
    play(true);
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
  find("play").addEventListener("click", () => play(!playing));
  find("scrub").addEventListener("input", (event) => seek(Number(event.target.value)));
  find("form").addEventListener("change", (event) => choose(event.target.name, event.target.value));
  find("form").addEventListener("submit", (event) => {
    event.preventDefault();
    if (!missing()) go(1);
  });

  const tracks = find("tracks");
  let dragging = false;
  const drag = (event) => {
    const box = tracks.getBoundingClientRect();
    if (dragging) seek((shown.duration * (event.clientX - box.left)) / box.width);
  };
  tracks.addEventListener("pointerdown", (event) => {
    dragging = true;
    tracks.setPointerCapture(event.pointerId);
    drag(event);
  });
  tracks.addEventListener("pointermove", drag);
  for (const end of ["pointerup", "pointercancel"]) tracks.addEventListener(end, () => (dragging = false));

  document.addEventListener("keydown", (event) => {
    if (!shown || event.ctrlKey || event.metaKey || event.altKey || event.target.matches("select")) return;
    const radio = event.target.matches("[type=radio]"), range = event.target.matches("[type=range]");
    const digit = /^[1-6]$/.test(event.key) && document.querySelectorAll(".choices input")[Number(event.key) - 1];
    if (event.key === " " && !event.target.matches("button, [type=radio]:not(:checked)")) play(!playing);
    else if (/^Arrow(Left|Right)$/.test(event.key) && !radio && !range) seek(Math.min(time, shown.duration) + (event.key === "ArrowLeft" ? -0.25 : 0.25));
    else if (digit) digit.click();
    else if (event.key === "Enter" && !event.target.matches("button")) find("next").click();
    else return;
    event.preventDefault();
  });

  for (const element of document.querySelectorAll(".count")) element.textContent = survey.questions.length;
  find("code").textContent = rater;
  save();
  find("forgetful").hidden = keeps;
  show();
  requestAnimationFrame(tick);
})();
