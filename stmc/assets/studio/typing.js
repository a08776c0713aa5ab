// A text that is typed in place: a quick model makes the motion at every pause, and the whole text is one step of the
// history. Knows no elements.

import { promptOf } from "./state.js";

const PAUSE = 250; // milliseconds without a key

export function createTyping(studio) {
  let typed = null; // {id, gesture, before}, of a prompt; `before` is its text
  let pause = null;

  const textOf = (id) => promptOf(studio.present(), id)?.text ?? "";

  function write(id, text) {
    if (typed?.id !== id) typed = { id, gesture: studio.gesture("typing"), before: textOf(id) };
    studio.edit({ kind: "write", id, text }, typed.gesture);
  }

  return {
    // After each key.
    typed(id, text) {
      clearTimeout(pause);
      if (studio.quick() && text.trim()) pause = setTimeout(() => write(id, text), PAUSE);
    },
    // The text before any key.
    before: (id) => (typed?.id === id ? typed.before : textOf(id)),
    // Once the field is left.
    finish(id, text) {
      clearTimeout(pause);
      if (text !== textOf(id)) write(id, text);
      studio.settle();
      typed = null;
    },
  };
}
