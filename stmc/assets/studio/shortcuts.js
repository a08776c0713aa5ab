// What keys do: everywhere, and to the prompt that has the focus. The help dialog lists them from here.

import { find } from "./dom.js";
import { GRID, PARTS, promptOf, rounded } from "./state.js";

export const HELP = [
  ["The timeline", [
    ["N", "write a prompt at the cursor"],
    ["J / K", "next, previous prompt"],
    ["← →", "move the prompt by 0.1 s, with Ctrl by 1 s"],
    ["↑ ↓", "to the track above, beneath"],
    ["Shift + ← →", "move its end"],
    ["Alt + ← →", "move its start"],
    ["Enter", "type its text"],
    ["1 … 5", "left arm, right arm, legs, head, spine: claim or leave"],
    ["S", "split it at the cursor"],
    ["D", "duplicate it"],
    ["L", "lock it, unlock it"],
    ["M", "regenerate it, or the chosen interval"],
    ["Delete", "delete it"],
  ]],
  ["Time", [
    ["Space", "play, pause"],
    ["V", "Live: start, stop"],
    [", .", "a frame back, forward"],
    ["Home / End", "to the beginning, to the end"],
    ["I / O", "the interval begins, ends at the cursor"],
    ["X", "no interval"],
    ["+ −", "closer, wider"],
  ]],
  ["All", [
    ["Ctrl + Z", "undo"],
    ["Ctrl + Shift + Z", "redo"],
    ["Ctrl + Enter", "generate"],
    ["Escape", "cancel what runs or is drawn"],
    ["F", "the camera follows, or stays"],
    ["P", "pull the pose by hands, feet and head"],
    ["?", "this help"],
  ]],
];

const typing = (target) => target.matches("input:not([type=checkbox],[type=radio],[type=range]), textarea, select");

export function listenToShortcuts(studio, player, work, tracks, page) {
  const { store } = studio;

  const id = () => store.get().selected;
  const edit = (kind, more = {}) => id() && studio.edit({ kind, id: id(), ...more });
  const make = (kind, more = {}) => {
    if (!id()) return;
    studio.make({ kind, id: id(), ...more });
    focusLater();
  };
  const focusLater = () => queueMicrotask(() => tracks.focus(id())); // once the tracks show it

  function shift({ start = 0, end = 0, track = 0 }) {
    const prompt = promptOf(studio.present(), id());
    const by = Math.max(start, -prompt.start);
    studio.edit({
      kind: "place", id: id(), track: Math.max(0, prompt.track + track),
      start: Math.min(prompt.start + by, start === end ? Infinity : prompt.end - GRID),
      end: start === end ? prompt.end + by : Math.max(prompt.end + end, prompt.start + GRID),
    });
    focusLater();
  }

  function step(by) {
    const { prompts } = studio.present();
    const index = prompts.findIndex((prompt) => prompt.id === id());
    const next = prompts[(index < 0 ? (by > 0 ? 0 : prompts.length - 1) : index + by + prompts.length) % prompts.length];
    if (next) store.set({ selected: next.id });
    focusLater();
  }

  function remove() {
    const { prompts } = studio.present();
    const index = prompts.findIndex((prompt) => prompt.id === id());
    const next = prompts[index + 1] ?? prompts[index - 1];
    edit("remove");
    store.set({ selected: next?.id ?? null });
    focusLater();
  }

  function claim(number) {
    const prompt = promptOf(studio.present(), id());
    const now = prompt.parts.length ? prompt.parts : store.get().check?.prompts[id()]?.parts ?? [];
    const part = PARTS[number];
    edit("claim", { parts: now.includes(part) ? now.filter((other) => other !== part) : [...now, part] });
  }

  function border(edge) {
    const { span } = store.get();
    const time = rounded(player.time());
    const other = span ?? { start: 0, end: studio.duration() };
    const next = { ...other, [edge]: time };
    store.set({ span: next.end > next.start ? next : null });
  }

  function moved(event) {
    const by = (event.key === "ArrowLeft" ? -1 : 1) * (event.ctrlKey || event.metaKey ? 10 : 1) * GRID;
    if (event.shiftKey) shift({ end: by });
    else if (event.altKey) shift({ start: by });
    else shift({ start: by, end: by });
  }

  const ON_PROMPT = {
    ArrowLeft: moved,
    ArrowRight: moved,
    ArrowUp: () => shift({ track: -1 }),
    ArrowDown: () => shift({ track: 1 }),
    Enter: () => store.set({ editing: id() }),
    F2: () => store.set({ editing: id() }),
    Delete: remove,
    Backspace: remove,
  };

  const PLAIN = {
    " ": () => player.play(),
    n: page.write,
    v: page.toggleLive,
    j: () => step(1),
    k: () => step(-1),
    s: () => make("split", { at: player.time() }),
    d: () => make("duplicate"),
    l: () => edit("lockPrompt"),
    m: () => (store.get().span ? work.regenerateSpan(store.get().span) : id() && work.regeneratePrompt(id())),
    ",": () => player.seek(player.time() - 1 / page.fps()),
    ".": () => player.seek(Math.min(player.time() + 1 / page.fps(), studio.duration())),
    Home: () => player.seek(0),
    End: () => player.seek(studio.duration()),
    i: () => border("start"),
    o: () => border("end"),
    x: () => store.set({ span: null }),
    f: page.toggleFollow,
    p: page.togglePull,
    "+": () => tracks.zoomBy(1.3),
    "-": () => tracks.zoomBy(1 / 1.3),
    "?": page.help,
    Escape: page.escape,
  };
  PARTS.forEach((_, number) => (PLAIN[number + 1] = () => id() && claim(number)));

  const WITH_CONTROL = {
    z: (event) => (event.shiftKey ? studio.redo() : studio.undo()),
    y: () => studio.redo(),
    s: page.save,
    Enter: () => work.generate(),
  };

  // The cursor, where the ruler has the focus.
  const ON_RULER = {
    ArrowLeft: (event) => player.seek(player.time() - (event.shiftKey ? 1 : GRID)),
    ArrowRight: (event) => player.seek(Math.min(player.time() + (event.shiftKey ? 1 : GRID), studio.duration())),
  };

  function actOf(event) {
    const { target, key } = event;
    const control = event.ctrlKey || event.metaKey;
    if (target.matches(".bar") && ON_PROMPT[key] && id()) return ON_PROMPT[key];
    if (target === find("ruler") && ON_RULER[key]) return ON_RULER[key];
    if (control) return WITH_CONTROL[key.length === 1 ? key.toLowerCase() : key];
    if (event.altKey || (key === " " && target.closest("button, a, summary, [role=tab]"))) return null;
    return PLAIN[key.length === 1 ? key.toLowerCase() : key];
  }

  // Of a field, with what stood there before; what is typed next is a key of the page.
  function leave(field) {
    if ("defaultValue" in field) field.value = field.defaultValue;
    field.blur();
  }

  document.addEventListener("keydown", (event) => {
    if (document.querySelector("dialog[open], :popover-open")) return;
    const undoing = (event.ctrlKey || event.metaKey) && event.key === "Enter";
    if (typing(event.target) && event.key === "Escape" && !event.isComposing) return leave(event.target);
    if (typing(event.target) && !undoing) return;
    if (event.target.matches("input[type=range]") && event.key.startsWith("Arrow")) return;
    const act = actOf(event);
    if (!act) return;
    event.preventDefault();
    act(event);
  });
}
