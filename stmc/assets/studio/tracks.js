// The tracks: prompts as bars to drag and stretch, the body parts' rows beneath, the cursor, and a span of time. Draws
// the state and turns what hands do into edits; `track_keys.js` does so for keys.

import { button, fill, find, icon, keyed, make, watch } from "./dom.js";
import { PARTS, promptOf, rounded, trackCount } from "./state.js";
import { colourOf, inkOn, NEUTRAL } from "./colours.js";
import { demandOf, errorOf, kindOf, meets, spanOf, titleOf } from "./constraints.js";
import { rulerStep, snapped, snappedShift, written } from "./times.js";
import { DRAFT } from "./typing.js";

const NEAR = 9; // pixels within which things snap
const SHORTEST_VIEW = 6; // seconds
const LIVE_VIEW = 12; // seconds that are to be seen while a stream plays
const MARGIN = 34; // pixels behind the last second: room for its number
const BORDER = 24; // pixels at the window's edges where a drag goes on by itself
const PACE = 10; // pixels of each picture by which it does

export function createTracks(studio, player, work, typing) {
  const { store } = studio;
  const [scroller, lanes, ruler, bars, rows, parts] = ["scroller", "lanes", "ruler", "bars", "track-rows", "part-rows"].map(find);
  const [playhead, range] = [find("playhead"), find("range")];
  let zoom = 1;
  let height = 36; // pixels of a track
  let extent = SHORTEST_VIEW; // seconds to be seen
  let held = null; // what a pointer drags
  let beyond = 0; // pixels by which a drag has lengthened the tracks

  // ---- scale ------------------------------------------------------------------------------------------------------------
  const labelWidth = () => ruler.offsetLeft;
  const views = () => (store.get().live ? (zoom * extent) / LIVE_VIEW : zoom); // how many times as wide as the window the tracks are
  const scale = () => (views() * (scroller.clientWidth - labelWidth() - MARGIN)) / extent;
  const timeAt = (event) => (event.clientX - ruler.getBoundingClientRect().left) / scale();
  const x = (seconds) => `${seconds * scale()}px`;

  function measure() {
    height = parseFloat(getComputedStyle(document.documentElement).getPropertyValue("--row"));
    if (held) return; // or the tracks would run away beneath the hand
    extent = store.get().live ? liveExtent() : Math.max(SHORTEST_VIEW, studio.duration() * 1.06 + 0.4);
  }

  // Room to write ahead, in steps, so that the tracks grow seldom.
  const liveExtent = () => LIVE_VIEW * Math.ceil(studio.duration() / LIVE_VIEW + 1);

  // What edges snap to: other prompts' edges, the cursor, the beginning, the span's ends.
  function marks(id) {
    const { history, span } = store.get();
    const others = history.present.prompts.filter((prompt) => prompt.id !== id);
    return [0, player.time(), ...others.flatMap(({ start, end }) => [start, end]), ...(span ? [span.start, span.end] : [])];
  }

  // ---- drawing ----------------------------------------------------------------------------------------------------------
  function paint() {
    measure();
    const state = store.get();
    const { present } = state.history;
    const count = Math.max(trackCount(present), (state.draft?.track ?? -1) + 1) + 1;
    lanes.style.width = `${labelWidth() + views() * (scroller.clientWidth - labelWidth() - 2) + beyond}px`;
    keyed(rows, Array.from({ length: count }, (_, track) => track), (track) => track, createRow, () => {});
    bars.style.height = `${count * height}px`;
    bars.style.left = `${labelWidth()}px`;
    keyed(bars, shownPrompts(state), ({ id }) => id, createBar, (bar, prompt) => paintBar(bar, prompt, state));
    paintRuler();
    paintParts(state);
    keyed(find("constraint-rows"), present.constraints, ({ id }) => id, createConstraint, (row, each) => paintConstraint(row, each, state));
    paintRange(state);
    paintCursor();
  }

  // A draft stands for the prompt that it has become.
  function shownPrompts({ draft, history: { present } }) {
    if (!draft) return present.prompts;
    const colour = promptOf(present, draft.prompt)?.colour ?? present.prompts.length;
    return [...present.prompts.filter(({ id }) => id !== draft.prompt), { ...draft, id: DRAFT, text: "", parts: [], colour }];
  }

  function createRow(track) {
    const label = make("div", { class: "label faint" }, `Track ${track + 1}`);
    return make("div", { class: "row", "data-track": track }, label, make("div", { class: "lane" }));
  }

  function createBar({ id }) {
    return make("div", { class: "bar", role: "button", "aria-roledescription": "prompt", id: `bar-${id}` },
      make("i", { class: "grip start" }), make("span", { class: "text" }), make("span", { class: "badges" }), make("i", { class: "grip end" }));
  }

  function paintBar(bar, prompt, state) {
    const { id, text, start, end, track, locked } = prompt;
    const colour = colourOf(prompt.colour);
    const checkedId = prompt.prompt ?? id; // of the prompt that a draft has become
    const told = state.check?.prompts[checkedId];
    const doubt = told?.advice ?? null;
    const wrong = state.check?.prompt === checkedId ? state.check.error : null;
    const chosen = state.selected === id || id === DRAFT;
    bar.style.cssText = `left:${x(start)};width:${x(end - start)};top:${track * height}px;--colour:${colour};--ink:${inkOn(colour)}`;
    bar.classList.toggle("chosen", chosen);
    bar.classList.toggle("unknown", Boolean(doubt || wrong));
    bar.classList.toggle("locked", Boolean(locked));
    bar.setAttribute("aria-pressed", String(chosen));
    const first = state.history.present.prompts[0]?.id;
    bar.tabIndex = chosen || (!state.selected && id === first) ? 0 : -1;
    bar.title = wrong ?? doubt?.sentence ?? text;
    const where = [`${written(start)} to ${written(end)}`, `track ${track + 1}`, ...(told?.parts ?? prompt.parts)].join(", ");
    const known = told && state.model?.contents.length ? "the model knows it" : null;
    const doubted = doubt?.known ? "it rarely works" : "the model hardly knows it";
    bar.setAttribute("aria-label", [text, where, doubt ? doubted : known, locked && "locked", wrong].filter(Boolean).join(". "));
    bar.children[2].replaceChildren(...[doubt || wrong ? make("b", {}, "?") : null, locked ? icon("lock") : null].filter(Boolean));
    paintText(bar, prompt, state.editing === id || id === DRAFT);
  }

  function paintText(bar, { id, text }, editing) {
    const place = bar.children[1];
    const field = place.querySelector("input");
    if (!editing) return place.textContent === text && !field ? null : place.replaceChildren(text);
    if (field) return null;
    const input = make("input", {
      value: text, placeholder: "What happens?", "aria-label": "Text of the prompt", list: "known-texts",
      onkeydown: (event) => typed(event, id), onblur: (event) => commit(event.target, id),
      oninput: (event) => typing.typed(id, event.target.value),
    });
    place.replaceChildren(input);
    input.focus();
    input.select();
  }

  function typed(event, id) {
    event.stopPropagation();
    if (event.key === "Escape") event.target.value = typing.before(id);
    if (event.key !== "Enter" && event.key !== "Escape") return;
    event.preventDefault();
    commit(event.target, id);
    queueMicrotask(() => document.getElementById(`bar-${store.get().selected}`)?.focus());
  }

  function commit(input, id) {
    const { draft, editing } = store.get();
    if (id === DRAFT ? !draft : editing !== id) return;
    store.set({ editing: null });
    typing.finish(id, input.value);
  }

  function paintRuler() {
    const step = rulerStep(scale());
    const seconds = Array.from({ length: Math.floor((extent + beyond / scale()) / step) + 1 }, (_, index) => index * step);
    keyed(ruler, seconds, (second) => second, (second) => make("b", {}, String(second)), (mark, second) => (mark.style.left = x(second)));
    ruler.setAttribute("aria-valuemax", rounded(studio.duration()));
    lanes.style.setProperty("--second", `${scale()}px`);
  }

  // ---- body parts' rows -----------------------------------------------------------------------------------------------------
  function paintParts(state) {
    keyed(parts, PARTS, (part) => part, createPart, (row, part) => paintPart(row, part, state));
  }

  function createPart(part) {
    const name = button(part, () => studio.edit({ kind: "lockPart", part }), { class: "label", title: `Lock the ${part}`, "aria-label": `Lock the ${part}` }, "lock");
    return make("div", { class: "row part" }, name, make("div", { class: "lane" }));
  }

  function paintPart(row, part, { history, check }) {
    const { present } = history;
    const locked = present.locks.parts.includes(part);
    row.firstChild.setAttribute("aria-pressed", String(locked));
    row.classList.toggle("locked", locked);
    const says = (check?.owners[part] ?? []).map(([id, start, end]) => `${promptOf(present, id)?.text ?? "nothing"} ${written(start)} to ${written(end)}`);
    row.firstChild.setAttribute("aria-description", says.join(", "));
    const block = ({ start, end }, kind, colour) =>
      make("i", { class: kind, style: `left:${x(start)};width:${x(end - start)};${colour ? `background:${colour}` : ""}` });
    const owned = (check?.owners[part] ?? []).map(([id, start, end]) => {
      const prompt = promptOf(present, id);
      const kept = prompt?.locked || (present.locks.gaps && !check.prompts[id]?.parts.includes(part));
      return block({ start, end }, kept ? "owned held" : "owned", prompt ? colourOf(prompt.colour) : NEUTRAL);
    });
    const changing = (check?.transitions[part] ?? []).map(([start, end]) => block({ start, end }, "transition"));
    const held = present.locks.spans.map((span) => block(span, "held"));
    row.lastChild.replaceChildren(...owned, ...changing, ...held);
  }

  // ---- constraints' rows ------------------------------------------------------------------------------------------------
  function createConstraint({ id, kind }) {
    const open = () => {
      store.set({ constraint: id });
      find("tab-constraints").click(); // it may be the chosen one already
    };
    const name = button(kindOf(kind).title, open, { class: "label" }, kind);
    return make("div", { class: "row part demand" }, name, make("div", { class: "lane" }, make("i", { class: kind })));
  }

  function paintConstraint(row, each, { samples, chosen, constraint }) {
    const demand = demandOf(samples.find(({ key }) => key === chosen), each);
    const { start, end } = spanOf(each, studio.duration());
    row.classList.toggle("off", Boolean(demand) && !meets(each, demand));
    row.firstChild.setAttribute("aria-label", titleOf(each));
    row.firstChild.setAttribute("aria-pressed", String(constraint === each.id));
    row.title = [titleOf(each), demand && `${errorOf(demand)} away from it`].filter(Boolean).join(": ");
    row.lastChild.firstChild.style.cssText = `left:${x(start)};width:${x(end - start)}`;
  }

  // ---- the span ---------------------------------------------------------------------------------------------------------
  function paintRange({ span, history }) {
    const { spans } = history.present.locks;
    keyed(find("locked-spans"), spans, ({ start }) => start, ({ start }) =>
      button("", () => studio.edit({ kind: "unlockSpan", start }), { class: "unlock" }, "lock"),
    (mark, { start, end }) => {
      mark.style.cssText = `left:calc(${labelWidth()}px + ${x(start)});width:${x(end - start)}`;
      mark.setAttribute("aria-label", `Unlock ${written(start)} to ${written(end)}`);
      mark.title = mark.getAttribute("aria-label");
    });
    range.hidden = !span;
    if (!span) return;
    range.style.cssText = `left:calc(${labelWidth()}px + ${x(span.start)});width:${x(span.end - span.start)}`;
    const tools = find("span-tools");
    fill(tools,
      make("span", { class: "faint" }, `${written(span.start)} to ${written(span.end)}`),
      button("Regenerate", () => work.regenerateSpan(span), { "data-key": "regenerate" }, "dice"),
      button("Lock", () => studio.edit({ kind: "lockSpan", ...span }), { "data-key": "lock" }, "lock"),
      button("", () => store.set({ span: null }), { "aria-label": "Clear the interval", "data-key": "clear" }, "close"));
  }

  function paintCursor() {
    playhead.style.left = `calc(${labelWidth()}px + ${x(player.time())})`;
    ruler.setAttribute("aria-valuenow", player.time().toFixed(2));
    ruler.setAttribute("aria-valuetext", written(player.time()));
    paintLive(store.get().live);
    if (player.playing()) reveal(player.time());
  }

  // What has come of a stream does not change any more.
  function paintLive(live) {
    const fixed = find("fixed");
    fixed.hidden = !live;
    if (live) fixed.style.cssText = `left:${labelWidth()}px;width:${x(live.seconds)}`;
  }

  function reveal(time) {
    const at = time * scale() + labelWidth();
    if (store.get().live && player.playing() && !held) return (scroller.scrollLeft = at - labelWidth() - scroller.clientWidth / 3);
    if (at > scroller.scrollLeft + scroller.clientWidth - 20 || at < scroller.scrollLeft + labelWidth())
      scroller.scrollLeft = Math.max(0, at - labelWidth() - 40);
  }

  // ---- hands --------------------------------------------------------------------------------------------------------------
  function grab(event) {
    const bar = event.target.closest(".bar");
    if (event.button || event.target.closest("input")) return;
    if (!bar) return bars === event.target ? store.set({ selected: null, span: null }) : null;
    const prompt = promptOf(studio.present(), bar.dataset.key);
    if (!prompt) return;
    const chosen = store.get().selected === prompt.id;
    store.set({ selected: prompt.id });
    bar.focus({ preventScroll: true });
    if (event.pointerType === "touch" && !chosen) return; // the first touch chooses, the next one drags
    event.preventDefault();
    const kind = event.target.classList.contains("start") ? "start" : event.target.classList.contains("end") ? "end" : "move";
    held = { kind, prompt, at: timeAt(event), y: event.clientY, gesture: studio.gesture(), moved: false, event };
    bars.setPointerCapture(event.pointerId);
    requestAnimationFrame(goOn);
  }

  // At the window's edge the tracks run on beneath the hand, and grow longer where they end.
  function goOn() {
    if (!held) return;
    requestAnimationFrame(goOn);
    if (!held.moved) return;
    const { left, right } = scroller.getBoundingClientRect();
    const by = held.event.clientX > right - BORDER ? PACE : held.event.clientX < left + labelWidth() + BORDER ? -PACE : 0;
    const before = scroller.scrollLeft;
    if (by > 0) beyond += Math.max(0, before + scroller.clientWidth + by - lanes.offsetWidth);
    if (by > 0) lanes.style.width = `${Math.max(lanes.offsetWidth, before + scroller.clientWidth + by)}px`;
    scroller.scrollLeft += by;
    if (scroller.scrollLeft !== before) drag(held.event);
  }

  function drag(event) {
    if (!held) return;
    held.event = event;
    const { kind, prompt, at, y, gesture } = held;
    const by = timeAt(event) - at;
    if (!held.moved && Math.abs(by) * scale() < 3 && Math.abs(event.clientY - y) < 6) return;
    held.moved = true;
    const reach = event.altKey ? 0 : NEAR / scale();
    const around = event.altKey ? [] : marks(prompt.id);
    let { start, end, track } = prompt;
    if (kind === "start") start = Math.min(snapped(start + by, around, reach), end - 0.1);
    else if (kind === "end") end = Math.max(snapped(end + by, around, reach), start + 0.1);
    else {
      const moved = Math.max(-start, by);
      const shift = Math.max(-start, moved + snappedShift(start + moved, end + moved, around, reach));
      [start, end] = [start + shift, end + shift];
      track = Math.max(0, track + Math.round((event.clientY - y) / height));
    }
    studio.edit({ kind: "place", id: prompt.id, start, end, track }, gesture);
  }

  function drop() {
    if (!held) return;
    [held, beyond] = [null, 0];
    studio.settle();
    paint();
  }

  function begin(event) {
    const under = document.elementFromPoint(event.clientX, event.clientY); // the target is what held the pointer
    const bar = under?.closest(".bar");
    if (bar) return under.closest("input") ? null : store.set({ editing: bar.dataset.key, selected: bar.dataset.key });
    const start = Math.max(0, snapped(timeAt(event) - 0.5, marks(null), NEAR / scale()));
    const track = Math.floor((event.clientY - bars.getBoundingClientRect().top) / height);
    draft(start, track);
  }

  // A prompt to be typed, as long as there is room for it on its track, three seconds at most.
  function draft(start, track) {
    const later = studio.present().prompts.filter((prompt) => prompt.track === track && prompt.end > start);
    const room = Math.min(3, ...later.map((prompt) => prompt.start - start).filter((free) => free > 0.5));
    const taken = later.some((prompt) => prompt.start <= start);
    store.set({ draft: { start, end: rounded(start + room), track: taken ? trackCount(studio.present()) : track }, selected: null });
  }

  bars.addEventListener("pointerdown", grab);
  bars.addEventListener("pointermove", drag);
  for (const end of ["pointerup", "pointercancel"]) bars.addEventListener(end, drop);
  bars.addEventListener("dblclick", begin);
  bars.addEventListener("focusin", ({ target }) => {
    const bar = target.closest(".bar");
    if (bar && target === bar && bar.dataset.key !== DRAFT) store.set({ selected: bar.dataset.key });
  });

  // Along the ruler the cursor goes; along the body parts' rows, and with Shift, a span is chosen.
  function sweep(place, choosing) {
    let from = null;
    place.addEventListener("pointerdown", (event) => {
      if (event.button || event.target.closest("button")) return;
      from = { time: timeAt(event), spans: choosing || event.shiftKey };
      place.setPointerCapture(event.pointerId);
      if (from.spans) store.set({ span: null });
      else player.seek(Math.min(Math.max(0, from.time), studio.duration()));
    });
    place.addEventListener("pointermove", (event) => {
      if (!from) return;
      const time = timeAt(event);
      if (!from.spans) return player.seek(Math.min(Math.max(0, time), studio.duration()));
      const [start, end] = [from.time, time].sort((one, other) => one - other).map((edge) => Math.min(Math.max(0, snapped(edge, marks(null), NEAR / scale())), studio.duration()));
      store.set({ span: end - start >= 0.1 ? { start, end } : null });
    });
    for (const end of ["pointerup", "pointercancel"]) place.addEventListener(end, () => (from = null));
  }
  sweep(ruler, false);
  sweep(parts, true);

  scroller.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey) return;
    event.preventDefault();
    zoomBy(event.deltaY < 0 ? 1.2 : 1 / 1.2);
  }, { passive: false });

  function zoomBy(factor) {
    zoom = Math.min(Math.max(zoom * factor, 1), 20);
    paint();
    reveal(player.time());
  }

  new ResizeObserver(paint).observe(scroller);
  player.listen(paintCursor);
  watch(store, ({ history, check, selected, editing, draft: fresh, span, samples, chosen, constraint, live }) =>
    [history.present, check, selected, editing, fresh, span, samples, chosen, constraint, live && liveExtent()], paint);
  return { draft, zoomBy, focus: (id) => document.getElementById(`bar-${id}`)?.focus() };
}
