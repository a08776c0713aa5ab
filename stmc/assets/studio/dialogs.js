// The dialogs: open and new, export, help, and the choice between two tabs' versions.

import * as server from "./server.js";
import { button, fill, find, make, say } from "./dom.js";
import { HELP } from "./shortcuts.js";
import { timelineOf } from "./state.js";
import { argued } from "./actions.js";
import { drawFilm, drawsFilm } from "./film.js";

const FRAME_RATES = [20, 24, 25, 30, 50, 60, 120];

export function show(id) {
  const dialog = find(id);
  if (!dialog.open) dialog.showModal();
  return dialog;
}

for (const dialog of document.querySelectorAll("dialog:has([data-close])"))
  dialog.addEventListener("click", (event) => {
    if (event.target === dialog || event.target.closest("[data-close]")) dialog.close();
  });

export function download(blob, name) {
  const link = make("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

const fileName = (name) => name.trim().replace(/[^\p{L}\p{N} _-]+/gu, "").replace(/ +/g, "_").slice(0, 60) || "motion";

export function openHelp() {
  find("help-keys").replaceChildren(...HELP.map(([title, keys]) => make("section", {}, make("h3", {}, title),
    make("dl", {}, keys.flatMap(([key, does]) => [make("dt", {}, make("kbd", {}, key)), make("dd", {}, does)])))));
  show("help-dialog");
}

// ---- opening ------------------------------------------------------------------------------------------------------------
export async function openOpen(studio, saving, begin) {
  const dialog = show("open-dialog");
  const examples = studio.store.get().model?.examples ?? [];
  const { receives = [], characters } = studio.store.get().model ?? {};
  const figures = characters?.receives ?? [];
  find("open-file").accept = [".json", ".txt", ...receives, ...figures].join();
  find("open-about").textContent =
    `A timeline (.json, .txt), a recorded motion to begin from (${receives.join(", ")}), or a character (${figures.join(", ")}).`;
  const leave = (act) => async () => {
    dialog.close();
    try {
      await act();
    } catch (error) {
      say(error.message);
    }
  };
  const example = ({ name, timeline }) => make("li", {}, button(name, leave(() => begin.timeline({ ...timeline, name: timeline.name || name })), { class: "entry" }));
  fill(find("open-examples"), ...examples.map(example));
  fill(find("open-documents"), make("li", { class: "faint" }, "…"));
  find("open-new").onclick = leave(() => saving.create());
  find("open-file").onchange = ({ target }) => {
    const [file] = target.files;
    target.value = "";
    if (file) leave(() => begin.file(file))();
  };
  const documents = await server.listDocuments().catch(() => []);
  const recent = [...documents].sort((one, other) => (one.changed < other.changed ? 1 : -1));
  fill(find("open-documents"), ...recent.map((each) => ofDocument(each, leave(() => saving.open(each.id)), studio)),
    recent.length ? null : make("li", { class: "faint" }, "None yet."));
}

function ofDocument({ id, name, changed }, open, studio) {
  const current = studio.store.get().id === id;
  const when = new Date(typeof changed === "number" ? changed * 1000 : changed);
  const item = make("li", {}, button(name || "Untitled", open, { class: "entry", "aria-current": current && "true" }),
    make("span", { class: "faint" }, Number.isNaN(when.valueOf()) ? "" : when.toLocaleString([], { dateStyle: "medium", timeStyle: "short" })),
    current ? null : button("", async () => {
      await server.deleteDocument(id).catch((error) => say(error.message));
      item.remove();
    }, { class: "plain", "aria-label": `Delete ${name}` }, "trash"));
  return item;
}

// ---- taking away ----------------------------------------------------------------------------------------------------------
export function openExport(studio) {
  const sample = studio.chosen();
  const { model } = studio.store.get();
  const { name } = studio.present();
  const worn = studio.worn();
  const formats = (worn && !worn.missing ? worn.formats : model?.formats) ?? [];
  show("export-dialog");
  if (!drawsFilm()) find("export-told").textContent = "";
  find("export-motion").disabled = !sample || drawsFilm();
  find("export-none").hidden = Boolean(sample);
  fill(find("export-formats"), ...formats.map((format, index) => make("label", { class: "choice" },
    make("input", { type: "radio", name: "format", value: format.name, checked: index === 0 }),
    make("b", {}, `.${format.name}`), make("span", { class: "faint" }, format.about))));
  const shows = formats.filter(({ character }) => character).map((format) => `.${format.name}`);
  find("export-figure").hidden = !shows.length;
  find("export-figure").textContent = `${shows.join(", ")} show ${worn?.name}; the others show the mannequin.`;
  const own = sample?.motion.fps ?? model?.fps;
  fill(find("export-fps"), ...[...new Set([own, ...FRAME_RATES])].filter(Boolean).map((fps) =>
    make("option", { value: String(fps), selected: fps === own }, `${fps} frames a second${fps === own ? " (as made)" : ""}`)));

  find("export-motion").onclick = async () => {
    const format = formats.find(({ name }) => name === document.querySelector("input[name=format]:checked").value);
    const fps = Number(find("export-fps").value), loop = find("export-loop").checked;
    const file = () => (format.drawn ? drawFilm({ motion: sample.motion.id, format: format.name, fps, loop, timeline: timelineOrNull() })
      : server.motionFile(sample.motion.id, format.name, settingsOf(format, fps, loop)));
    await working(find("export-motion"), async () =>
      download(await file(), `${fileName(name)}${loop ? "_loop" : ""}.${format.name}`),
    format.drawn ? "Drawing the film, some four pictures a second…" : "Writing the file…");
  };
  // A recorded motion may have no prompts, and there are no timelines without any.
  const timelineOrNull = () => (studio.present().prompts.length ? timelineOf(studio.present()) : null);
  function settingsOf(format, fps, loop) {
    const { constraints } = studio.present();
    return {
      fps: String(fps), timeline: JSON.stringify(timelineOrNull()),
      ...(loop ? { loop: "1" } : {}),
      ...(worn && !worn.missing ? { character: JSON.stringify(worn.id) } : {}),
      ...(format.name === "html" ? { constraints: JSON.stringify({ constraints: constraints.map(argued) }) } : {}),
    };
  }
  for (const format of ["json", "txt"])
    find(`export-${format}`).onclick = () => working(find(`export-${format}`), async () =>
      download(new Blob([await server.writeTimeline(timelineOf(studio.present()), format)]), `${fileName(name)}.${format}`));
}

async function working(element, act, during = "") {
  const told = find("export-told");
  element.disabled = true;
  element.classList.add("busy");
  told.textContent = during;
  try {
    await act();
    told.textContent = "Saved.";
  } catch (error) {
    told.textContent = error.message;
  }
  element.disabled = false;
  element.classList.remove("busy");
}

// ---- two tabs -------------------------------------------------------------------------------------------------------------
// "mine", "theirs" or "both".
export function askConflict() {
  const dialog = show("conflict-dialog");
  return new Promise((answer) => {
    for (const choice of ["mine", "theirs", "both"])
      find(`conflict-${choice}`).onclick = () => {
        dialog.onclose = null;
        dialog.close();
        answer(choice);
      };
    dialog.onclose = () => dialog.showModal(); // Escape closes it: there is no third version to go on with
  });
}
