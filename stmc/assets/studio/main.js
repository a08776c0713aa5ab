// Puts the page together: the bar above, the player, the stage's samples, and what belongs to the page as a whole.

import * as server from "./server.js";
import { find, roomStyle, say, tell, watch } from "./dom.js";
import { colourOf, partColour } from "./colours.js";
import { askConflict, openExport, openHelp, openOpen } from "./dialogs.js";
import { createCharacterMenu, listenToDrops } from "./character_menu.js";
import { createConstraintPanel } from "./constraint_panel.js";
import { fieldOf, learn } from "./constraints.js";
import { createLive } from "./live.js";
import { createPlayer } from "./player.js";
import { createPromptPanel, createSamplesPanel, createWordsPanel } from "./panels.js";
import { createSaving } from "./saving.js";
import { createPreview } from "./preview.js";
import { createStage } from "./stage.js";
import { createStudio } from "./studio.js";
import { createTracks } from "./tracks.js";
import { createTransport } from "./transport.js";
import { createTyping } from "./typing.js";
import { createActions } from "./actions.js";
import { listenToShortcuts } from "./shortcuts.js";
import { documentOfTimeline, rounded, trackCount } from "./state.js";
import { clock } from "./times.js";

const studio = createStudio();
const { store } = studio;
const player = createPlayer(studio.playable);
const work = createActions(studio, crypto.randomUUID?.() ?? String(Math.random()), say);
const saving = createSaving(studio, askConflict);
const stage = createStage(find("stage"), {
  drawn: (points) => constraints.drawn(points),
  moved: (id, point, finished) => moved(id, point, finished),
  chosen: (id) => store.set({ constraint: id }),
  pulled: (joint, point, finished) => constraints.pulled(joint, point, finished),
});
const tracks = createTracks(studio, player, work, createTyping(studio));
const constraints = createConstraintPanel(studio, player, stage);
const live = createLive(studio, player, stage, work); // before the preview, which has the stage after a stream
const shown = createPreview(studio, stage);
createPromptPanel(studio, player, work, tracks);
createSamplesPanel(studio, work, shown);
createWordsPanel(studio, player, live.next);
const characters = createCharacterMenu(studio);

let dragged = null; // the gesture of a target's drag
function moved(id, point, finished) {
  const { kind } = studio.present().constraints.find((constraint) => constraint.id === id);
  dragged ??= studio.gesture();
  studio.edit({ kind: "adjust", id, change: { [fieldOf(kind, "point").name]: point.map(rounded) } }, dragged);
  if (!finished) return;
  dragged = null;
  studio.settle();
}

// ---- time ---------------------------------------------------------------------------------------------------------------
player.listen(stage.at);
const transport = createTransport(player, studio.playable);
// The first motion that is made plays once by itself; never into an edit, and not for those who want no motion.
let generated = false;
let played = matchMedia("(prefers-reduced-motion: reduce)").matches;
const openEdits = ({ draft, editing, history }) => [draft, editing, history.gesture];
watch(store, (state) => [state.samples, ...openEdits(state)], (state) => {
  generated ||= Boolean(state.job) && state.samples.some(({ steps }) => steps === state.quality);
  if (!generated || played || openEdits(state).some((each) => each !== null)) return;
  played = true;
  player.play(true);
});

// ---- the stage's own buttons --------------------------------------------------------------------------------------------
let follows = true;
function toggleFollow() {
  follows = !follows;
  find("follow").setAttribute("aria-pressed", String(follows));
  stage.follow(follows);
}
find("follow").onclick = toggleFollow;
find("reset-view").onclick = () => stage.reset();

function togglePull() {
  store.set({ pulling: !store.get().pulling });
}
find("pull").onclick = togglePull;
let grips = "";
function showGrips() {
  const joints = player.playing() || store.get().live ? [] : constraints.gripsOf(store.get());
  find("pull").setAttribute("aria-pressed", String(store.get().pulling));
  if (grips === joints.join()) return;
  grips = joints.join();
  stage.grip(joints);
}
watch(store, ({ pulling, constraint, samples, history, model }) => [pulling, constraint, samples, history, model], showGrips);
player.listen(showGrips);

watch(store, ({ drawing, span }) => [drawing, span], ({ drawing, span }) => {
  stage.draw(drawing ? span?.start ?? 0 : null);
  find("drawing").hidden = !drawing;
});
watch(store, ({ history, samples, live }) => [history.present.prompts.length, samples.length, live !== null], ({ history, samples, live }) => {
  find("empty").hidden = samples.length > 0 || live !== null;
  find("empty").textContent = history.present.prompts.length ? "No motion yet." : "Write a prompt on a track below, or open an example.";
});
watch(store, ({ history, constraint }) => [history.present.constraints, constraint],
  ({ history, constraint }) => stage.mark(history.present.constraints, constraint));
watch(store, ({ history, check }) => [history.present.prompts, check], ({ history, check }) => {
  const colours = new Map(history.present.prompts.map(({ id, colour }) => [id, colourOf(colour)]));
  stage.colour((part, time) => partColour(check?.owners[part], check?.transitions[part], time, colours));
});

// ---- generating ---------------------------------------------------------------------------------------------------------
const STAGES = { waiting: "Waiting", preview: "Preview", full: "Full quality" };
const samplesOf = ({ samples }) => `${samples.length} ${samples.length === 1 ? "sample" : "samples"} of ${clock(samples[0].motion.duration)} s`;
find("generate").onclick = () => (store.get().job ? work.cancel() : work.generate());
watch(store, ({ job, history, live }) => [job, history.present.prompts.length, live !== null], ({ job, history, live }) => {
  const share = job?.steps ? job.step / job.steps : 0;
  find("generate").querySelector("span").textContent = job ? "Cancel" : "Generate";
  find("generate").title = job ? "Cancel (Escape)" : "Generate (Ctrl Enter)";
  find("generate").classList.toggle("primary", !job);
  find("generate").disabled = live !== null || (!job && !history.present.prompts.length);
  find("progress").hidden = !job;
  const text = job ? `${STAGES[job.stage] ?? job.stage}${job.steps ? ` ${job.step}/${job.steps}` : ""}` : "";
  find("progress-bar").firstChild.style.width = `${100 * share}%`;
  find("progress-bar").setAttribute("aria-valuemax", job?.steps || 1);
  find("progress-bar").setAttribute("aria-valuenow", job?.step ?? 0);
  find("progress-bar").setAttribute("aria-valuetext", text);
  find("progress-text").textContent = text;
});
// Each stage, and how it ended, are read out once; each step would be too much.
let heard = { stage: null, samples: [] };
watch(store, ({ job, samples }) => [job?.stage, samples], (state) => {
  const stage = state.job?.stage ?? null;
  if (stage !== heard.stage && stage !== "waiting")
    tell(stage ? `Sampling: ${STAGES[stage]}.` : state.samples !== heard.samples && state.samples.length ? `Ready: ${samplesOf(state)}.` : "Stopped.");
  heard = { stage, samples: stage && heard.stage ? heard.samples : state.samples };
});
watch(store, ({ check }) => [check?.error], ({ check }) => check?.error && tell(check.error));

// ---- the bar above ------------------------------------------------------------------------------------------------------
const begin = {
  timeline: (timeline) => saving.create({ document: { ...documentOfTimeline(timeline), figure: studio.present().figure } }),
  async file(file) {
    if (characters.isOne(file)) return characters.add(file);
    if (store.get().model.receives.some((suffix) => file.name.toLowerCase().endsWith(suffix))) return upload(file);
    const { timelines } = await server.readTimelines(file.name, await file.text());
    begin.timeline(timelines[0]);
    if (timelines.length > 1) say(`The file has ${timelines.length} timelines; this is the first.`);
  },
};

// Of a recorded motion, what no prompt claims is kept.
async function upload(file) {
  const { motion } = await server.uploadMotion(file);
  const document = { ...documentOfTimeline({ name: file.name.replace(/\.\w+$/, ""), prompts: [] }), figure: studio.present().figure };
  document.locks = { ...document.locks, gaps: true };
  const sample = { key: "recorded", seed: null, steps: "recorded", motion, demands: [], missed: [], asked: {}, varied: true };
  saving.create({ document, samples: [sample], chosen: "recorded" });
  say("Of the recorded motion, what no prompt claims is kept: write prompts where it shall change.");
}

listenToDrops(begin.file);
find("open").onclick = () => openOpen(studio, saving, begin);
find("export").onclick = () => openExport(studio);
find("help").onclick = openHelp;
find("undo").onclick = studio.undo;
find("redo").onclick = studio.redo;
// A prompt at the cursor; while a stream plays, the next one.
const writePrompt = () =>
  store.get().live ? live.focus() : tracks.draft(rounded(Math.round(player.time() * 10) / 10), trackCount(studio.present()));
find("add").onclick = writePrompt;
find("zoom-in").onclick = () => tracks.zoomBy(1.3);
find("zoom-out").onclick = () => tracks.zoomBy(1 / 1.3);
find("name").onchange = ({ target }) => {
  studio.edit({ kind: "name", name: target.value });
  target.value = studio.present().name;
};
const SAVED = { saved: "Saved", saving: "Saving…", away: "Server away: kept in this browser", stranger: "Kept in this browser: open the studio's new address", conflict: "Changed in another tab" };
watch(store, ({ saved }) => [saved], ({ saved }) => !["saved", "saving"].includes(saved) && tell(`${SAVED[saved]}.`));
watch(store, ({ history, saved }) => [history, saved], ({ history, saved }) => {
  find("undo").disabled = !history.past.length;
  find("redo").disabled = !history.future.length;
  find("name").defaultValue = history.present.name;
  if (document.activeElement !== find("name")) find("name").value = history.present.name;
  find("saved").textContent = SAVED[saved];
  find("saved").dataset.state = saved;
  document.title = `${history.present.name} – stmc studio`;
  transport.show();
});

// ---- panels' tabs -------------------------------------------------------------------------------------------------------
const tabs = [...document.querySelectorAll("[role=tab]")];
function openTab(tab) {
  for (const each of tabs) {
    each.setAttribute("aria-selected", String(each === tab));
    each.tabIndex = each === tab ? 0 : -1;
    find(each.getAttribute("aria-controls")).hidden = each !== tab;
  }
}
for (const [index, tab] of tabs.entries()) {
  tab.onclick = () => openTab(tab);
  tab.onkeydown = ({ key }) => {
    const by = { ArrowRight: 1, ArrowLeft: -1 }[key];
    if (!by) return;
    const next = tabs[(index + by + tabs.length) % tabs.length];
    openTab(next);
    next.focus();
  };
}
watch(store, ({ selected }) => [selected], ({ selected }) => selected && find("tab-words").ariaSelected !== "true" && openTab(find("tab-prompt")));
watch(store, ({ constraint }) => [constraint], ({ constraint }) => constraint && openTab(find("tab-constraints")));

// ---- light and dark -----------------------------------------------------------------------------------------------------
const THEMES = { light: "dark", dark: "auto", auto: "light" };
const dark = matchMedia("(prefers-color-scheme: dark)");
function wear(theme) {
  document.documentElement.dataset.theme = theme === "auto" ? (dark.matches ? "dark" : "light") : theme;
  find("theme").dataset.theme = theme;
  find("theme").setAttribute("aria-label", `Colours: ${theme}`);
  find("theme").title = `Colours: ${theme}`;
  find("theme").querySelector("use").setAttribute("href", `#icon-${theme}`);
  stage.theme(roomStyle());
}
function recalledTheme() {
  try {
    return localStorage.getItem("stmc-studio-theme") ?? "auto";
  } catch {
    return "auto";
  }
}
find("theme").onclick = () => {
  const next = THEMES[find("theme").dataset.theme];
  try {
    localStorage.setItem("stmc-studio-theme", next);
  } catch {
    // worn for this visit alone
  }
  wear(next);
};
dark.addEventListener("change", () => wear(find("theme").dataset.theme));
wear(recalledTheme());

// ---- keys, and the beginning --------------------------------------------------------------------------------------------
listenToShortcuts(studio, player, work, tracks, {
  fps: () => store.get().model?.fps ?? 20,
  toggleFollow,
  togglePull,
  toggleLive: live.toggle,
  write: writePrompt,
  help: openHelp,
  save: () => openExport(studio),
  escape() {
    if (store.get().drawing) store.set({ drawing: false });
    else if (store.get().live) live.stop();
    else if (store.get().job) work.cancel();
    else store.set({ selected: null, span: null, pulling: false });
  },
});

// Who comes for the first time sees a person who does something.
async function first() {
  const documents = await server.listDocuments().catch(() => null);
  const [example] = store.get().model.examples;
  if (documents?.length === 0 && example) begin.timeline({ ...example.timeline, name: example.name });
  else saving.create();
}

async function start() {
  for (;;) {
    try {
      await server.enter();
      const model = await server.askModel();
      learn(model.constraints);
      store.set({ model });
      await characters.refresh();
      break;
    } catch (error) {
      if (error.status === 401) return say("This page needs the address that the studio printed when it started.");
      say("The server does not answer; trying again.");
      await new Promise((resolve) => setTimeout(resolve, 2000));
    }
  }
  const wanted = location.hash.slice(1) || saving.last();
  if (/^[\w-]{1,64}$/.test(wanted ?? "")) await saving.open(wanted);
  else await first();
  document.body.dataset.ready = "true";
}
addEventListener("hashchange", () => {
  const id = location.hash.slice(1);
  if (id.startsWith("token=")) location.reload(); // the address of a restarted studio
  else if (id && id !== store.get().id) saving.open(id);
});
start();
