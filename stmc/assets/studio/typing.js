// A text that is typed in place: a quick model makes the motion at every pause, and the whole text is one step of the
// history. A draft is a prompt of the document from its first pause on. Knows no elements.

import { promptOf } from "./state.js";

export const DRAFT = "draft"; // in place of a prompt's id
const PAUSE = 250; // milliseconds without a key

export function createTyping(studio) {
  const { store } = studio;
  let typed = null; // {id, gesture, before}, of a prompt or the draft; `before` is its text
  let pause = null;

  const promptIdOf = (id) => (id === DRAFT ? store.get().draft?.prompt : id);
  const textOf = (id) => promptOf(studio.present(), promptIdOf(id))?.text ?? "";

  function write(id, text) {
    if (typed?.id !== id) typed = { id, gesture: studio.gesture("typing"), before: textOf(id) };
    if (id !== DRAFT) return studio.edit({ kind: "write", id, text }, typed.gesture);
    const draft = { ...store.get().draft };
    draft.prompt ??= `p${studio.present().next}`; // each edit of a gesture begins where the first one did
    store.set({ draft });
    return studio.edit({ kind: "add", ...draft, text }, typed.gesture);
  }

  return {
    // After each key.
    typed(id, text) {
      clearTimeout(pause);
      if (studio.quick() && !store.get().live && text.trim()) pause = setTimeout(() => write(id, text), PAUSE);
    },
    // The text before any key.
    before: (id) => (typed?.id === id ? typed.before : textOf(id)),
    // Once the field is left. A draft that has a text is the chosen prompt.
    finish(id, text) {
      clearTimeout(pause);
      if (text !== textOf(id)) write(id, text);
      const promptId = promptIdOf(id);
      if (id === DRAFT) store.set({ draft: null });
      studio.settle();
      typed = null;
      if (id === DRAFT && promptOf(studio.present(), promptId)) store.set({ selected: promptId });
    },
  };
}
