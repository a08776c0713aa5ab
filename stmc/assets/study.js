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

  // ---- motions ------------------------------------------------------------------------------------------------------
  const POINTS = survey.tree.length;
  const HEAD = 15, CROWN = 24, NOSE = 25;
  const GREY = [176, 182, 192], LEFT = [111, 149, 196], RIGHT = [207, 154, 98];
  // [from, to, radius there, radius here (metres), colour]; points 26 to 28 are made up in `posed`
  const BONES = [
    [0, 1, 0.095, 0.09, GREY], [0, 2, 0.095, 0.09, GREY], [0, 3, 0.11, 0.112, GREY], [3, 6, 0.112, 0.118, GREY],
    [6, 9, 0.118, 0.122, GREY], [9, 12, 0.1, 0.052, GREY], [12, 15, 0.05, 0.05, GREY],
    [9, 13, 0.1, 0.075, GREY], [9, 14, 0.1, 0.075, GREY],
    [13, 16, 0.07, 0.06, LEFT], [16, 18, 0.055, 0.043, LEFT], [18, 20, 0.043, 0.032, LEFT], [20, 22, 0.036, 0.034, LEFT],
    [14, 17, 0.07, 0.06, RIGHT], [17, 19, 0.055, 0.043, RIGHT], [19, 21, 0.043, 0.032, RIGHT], [21, 23, 0.036, 0.034, RIGHT],
    [1, 4, 0.088, 0.06, LEFT], [4, 7, 0.06, 0.042, LEFT], [7, 10, 0.045, 0.036, LEFT],
    [2, 5, 0.088, 0.06, RIGHT], [5, 8, 0.06, 0.042, RIGHT], [8, 11, 0.045, 0.036, RIGHT],
    [26, 27, 0.085, 0.092, GREY], [28, 25, 0.03, 0.014, GREY],
  ];
  const FLESH = 0.13; // metres by which the body is thicker than its points

  function decoded(clip) {
    const bytes = Uint8Array.from(atob(clip.points), (letter) => letter.charCodeAt(0));
    const units = new Int16Array(bytes.buffer);
    const points = Float32Array.from(units, (value) => value * clip.unit);
    const frames = points.length / (3 * POINTS);
    return { points, frames, fps: clip.fps, path: smoothed(points, frames, clip.fps) };
  }

  // Where the camera looks in each frame: the pelvis' way over the floor without its swaying.
  function smoothed(points, frames, fps) {
    const reach = Math.ceil(fps);
    const path = new Float32Array(2 * frames);
    for (let frame = 0; frame < frames; frame++) {
      let total = 0;
      for (let step = -reach; step <= reach; step++) {
        const other = Math.min(Math.max(frame + step, 0), frames - 1);
        const weight = Math.exp(-0.5 * ((2.5 * step) / reach) ** 2);
        total += weight;
        for (const axis of [0, 1]) path[2 * frame + axis] += weight * points[3 * POINTS * other + axis];
      }
      for (const axis of [0, 1]) path[2 * frame + axis] /= total;
    }
    return path;
  }

  // One ball around both bodies, the same for both, so that both are of one size and always wholly in the picture.
  function ball(clips) {
    let low = Infinity, high = -Infinity;
    for (const { points } of clips)
      for (let at = 2; at < points.length; at += 3) {
        low = Math.min(low, points[at]);
        high = Math.max(high, points[at]);
      }
    const height = (low + high) / 2;
    let radius = 0;
    for (const { points, path } of clips)
      for (let at = 0; at < points.length; at += 3) {
        const frame = Math.floor(at / (3 * POINTS));
        const x = points[at] - path[2 * frame], y = points[at + 1] - path[2 * frame + 1];
        radius = Math.max(radius, Math.hypot(x, y, points[at + 2] - height));
      }
    return { height, radius: radius + FLESH };
  }

  function posed(clip, time) {
    const at = Math.min(time * clip.fps, clip.frames - 1);
    const frame = Math.min(Math.floor(at), Math.max(clip.frames - 2, 0));
    const share = clip.frames > 1 ? at - frame : 0;
    const mixed = (array, width, index) =>
      array[width * frame + index] * (1 - share) + (share && array[width * (frame + 1) + index] * share);
    const pose = [];
    for (let point = 0; point < POINTS; point++)
      pose.push([0, 1, 2].map((axis) => mixed(clip.points, 3 * POINTS, 3 * point + axis)));
    const between = (a, b, part) => [0, 1, 2].map((axis) => pose[a][axis] * (1 - part) + pose[b][axis] * part);
    pose.push(between(HEAD, CROWN, 0.25), between(HEAD, CROWN, 0.6), between(HEAD, NOSE, 0.6));
    return { pose, target: [mixed(clip.path, 2, 0), mixed(clip.path, 2, 1)] };
  }

  // ---- pictures -----------------------------------------------------------------------------------------------------
  const FOV = (30 * Math.PI) / 180;
  const TILE = 0.5; // metres
  const view = { azimuth: -Math.PI / 2 + 0.5, elevation: 0.24 };
  const canvases = [find("left"), find("right")];
  const shade = (colour, share) =>
    "rgb(" + colour.map((value) => Math.round(share < 1 ? value * share : value + (255 - value) * (share - 1))) + ")";

  const distance = (around) => (1.02 * around.radius) / Math.sin(FOV / 2);

  function projector(canvas, around, target) {
    const { clientWidth: wide, clientHeight: tall } = canvas;
    const [ca, sa, ce, se] = [Math.cos(view.azimuth), Math.sin(view.azimuth), Math.cos(view.elevation), Math.sin(view.elevation)];
    const away = distance(around);
    const focal = Math.min(wide, tall) / 2 / Math.tan(FOV / 2);
    return (point) => {
      const x = point[0] - target[0], y = point[1] - target[1], z = point[2] - around.height;
      const near = ce * (ca * x + sa * y) + se * z;
      const scale = focal / (away - near);
      return { x: wide / 2 + scale * (ca * y - sa * x), y: tall / 2 - scale * (ce * z - se * (ca * x + sa * y)), scale, depth: away - near };
    };
  }

  // A round piece of floor with half-metre tiles, fading towards its rim; every other line is a metre's.
  function drawFloor(context, project, target, reach) {
    for (const axis of [0, 1]) {
      const last = Math.floor((target[axis] + reach) / TILE);
      for (let line = Math.ceil((target[axis] - reach) / TILE); line <= last; line++) {
        const aside = line * TILE - target[axis];
        const half = Math.sqrt(Math.max(reach * reach - aside * aside, 0));
        const at = (along) => project(axis ? [target[0] + along, line * TILE, 0] : [line * TILE, target[1] + along, 0]);
        const [one, other] = [at(-half), at(half)];
        const fade = context.createLinearGradient(one.x, one.y, other.x, other.y);
        const middle = 0.55 * (half / reach) ** 2;
        for (const [place, alpha] of [[0, 0], [0.25, 0.6 * middle], [0.5, middle], [0.75, 0.6 * middle], [1, 0]])
          fade.addColorStop(place, `rgba(90, 100, 118, ${alpha})`);
        context.strokeStyle = fade;
        context.lineWidth = line % 2 ? 0.7 : 1.5;
        context.beginPath();
        context.moveTo(one.x, one.y);
        context.lineTo(other.x, other.y);
        context.stroke();
      }
    }
  }

  function drawShadow(context, project, pose) {
    context.strokeStyle = "#cfd3da";
    context.lineCap = "round";
    for (const [from, to, one, other] of BONES) {
      const [a, b] = [from, to].map((point) => project([pose[point][0], pose[point][1], 0]));
      context.lineWidth = Math.max((one + other) * a.scale, 1);
      context.beginPath();
      context.moveTo(a.x, a.y);
      context.lineTo(b.x, b.y + 0.01);
      context.stroke();
    }
  }

  // A limb: the hull of two circles, lighter on the side of the light.
  function drawLimb(context, a, b, one, other, colour) {
    const length = Math.hypot(b.x - a.x, b.y - a.y);
    const along = Math.atan2(b.y - a.y, b.x - a.x);
    context.beginPath();
    if (length <= Math.abs(one - other)) {
      const end = one > other ? a : b;
      context.arc(end.x, end.y, Math.max(one, other), 0, 2 * Math.PI);
    } else {
      const open = Math.acos((one - other) / length);
      context.arc(a.x, a.y, one, along + open, along - open + 2 * Math.PI);
      context.arc(b.x, b.y, other, along - open, along + open);
      context.closePath();
    }
    let across = [-Math.sin(along), Math.cos(along)];
    if (across[0] * -0.45 + across[1] * -0.9 < 0) across = [-across[0], -across[1]];
    const [x, y, r] = [(a.x + b.x) / 2, (a.y + b.y) / 2, Math.max(one, other)];
    const fill = context.createLinearGradient(x + r * across[0], y + r * across[1], x - r * across[0], y - r * across[1]);
    fill.addColorStop(0, shade(colour, 1.28));
    fill.addColorStop(0.45, shade(colour, 1));
    fill.addColorStop(1, shade(colour, 0.68));
    context.fillStyle = fill;
    context.strokeStyle = shade(colour, 0.6);
    context.lineWidth = 1;
    context.stroke();
    context.fill();
  }

  function draw(canvas, clip, around, time) {
    const density = window.devicePixelRatio || 1;
    const [wide, tall] = [Math.round(canvas.clientWidth * density), Math.round(canvas.clientHeight * density)];
    if (canvas.width !== wide || canvas.height !== tall) [canvas.width, canvas.height] = [wide, tall];
    const context = canvas.getContext("2d");
    context.setTransform(density, 0, 0, density, 0, 0);
    context.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    const { pose, target } = posed(clip, time);
    const project = projector(canvas, around, target);
    drawFloor(context, project, target, Math.min(4, 0.8 * distance(around)));
    drawShadow(context, project, pose);
    const seen = pose.map(project);
    BONES.map(([from, to, one, other, colour]) => ({ a: seen[from], b: seen[to], one, other, colour }))
      .sort((x, y) => y.a.depth + y.b.depth - x.a.depth - x.b.depth)
      .forEach(({ a, b, one, other, colour }) => drawLimb(context, a, b, one * a.scale, other * b.scale, colour));
  }

  for (const canvas of canvases) {
    let held = null;
    canvas.addEventListener("pointerdown", (event) => {
      held = [event.clientX, event.clientY];
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!held) return;
      view.azimuth -= (event.clientX - held[0]) * 0.01;
      view.elevation = Math.min(Math.max(view.elevation + (event.clientY - held[1]) * 0.006, 0.03), 1.4);
      held = [event.clientX, event.clientY];
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => (held = null));
  }

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
