// All that the page shows, as one value, and what people do to it. Parts of the page listen; none knows another.

import { done, duration, historyOf, promptOf, redone, settled, undone, emptyDocument } from "./state.js";

export function createStore(initial) {
  let state = initial;
  let telling = false;
  const listeners = [];
  const tell = () => {
    telling = false;
    for (const listener of listeners) listener(state);
  };
  return {
    get: () => state,
    set(change) {
      state = { ...state, ...change };
      if (!telling) queueMicrotask(tell);
      telling = true;
    },
    subscribe: (listener) => listeners.push(listener),
  };
}

const QUICK = 8; // denoising steps

export const INITIAL = {
  model: null,
  characters: [], // that the server has: [{id, name, formats, corrections}]
  id: null, // of the document
  history: historyOf(emptyDocument()),
  check: null, // what the server says of the timeline, by the prompts' ids
  selected: null, // a prompt's id
  editing: null, // the prompt whose text is typed in place
  draft: null, // a prompt whose first text is being typed: {start, end, track, prompt: what it has become, if a motion shows it}
  span: null, // {start, end}
  constraint: null, // the chosen constraint's id
  pulling: false, // whether the pose at the cursor is to be pulled
  drawing: false, // or the kind of constraint whose line is drawn on the floor
  samples: [], // [{key, seed, steps, motion, demands, missed, asked, varied}]
  chosen: null, // the key of the sample that is kept and exported
  favourites: [], // [{motion, seed, picture, asked}]
  job: null, // {stage, seed, step, steps}
  live: null, // {seconds}: how much of a stream has come
  auto: true,
  quality: "full",
  saved: "saved", // or "saving", "away", "stranger" (to a restarted server), "conflict"
};

export function createStudio() {
  const store = createStore(INITIAL);
  const results = new WeakMap(); // document → the samples that it has got, for undo
  const present = () => store.get().history.present;
  let gestures = 0;

  // A document of the past brings its samples back.
  function turn(history) {
    const { selected, history: before } = store.get();
    const document = history.present;
    const another = document !== before.present || before.gesture !== null; // a text may have been typed and taken back
    const known = another && history.gesture === null ? results.get(document) : null;
    store.set({
      history,
      selected: promptOf(document, selected) ? selected : null,
      ...(known ? { samples: known.samples, chosen: known.chosen } : {}),
    });
  }

  const studio = {
    store,
    present,
    selected: () => promptOf(present(), store.get().selected),
    chosen: () => store.get().samples.find(({ key }) => key === store.get().chosen) ?? null,
    // The character that moves, null for the mannequin; as the server describes it where it is stored.
    worn() {
      const { character } = present().figure;
      return character && (store.get().characters.find(({ id }) => id === character.id) ?? { ...character, missing: true });
    },
    duration() {
      const { live } = store.get();
      return Math.max(duration(present()), live ? live.seconds : studio.chosen()?.motion.duration ?? 0);
    },
    // Seconds that can be played.
    playable: () => store.get().live?.seconds ?? studio.duration(),
    gesture: (kind = "drag") => `${kind} ${++gestures}`,
    // Whether a gesture of the hand goes on, whose motion would come too early.
    dragging: () => (store.get().history.gesture ?? "").startsWith("drag"),
    // Whether motions are made while one types: the model is one of few steps, and makes them by itself.
    quick: () => store.get().auto && (store.get().model?.steps.full ?? Infinity) <= QUICK,
    edit: (edit, gesture = null) => turn(done(store.get().history, edit, gesture)),
    // Adds, splits and duplicates choose what they made.
    make(edit) {
      const fresh = `p${present().next}`;
      studio.edit(edit);
      if (promptOf(present(), fresh)) store.set({ selected: fresh });
    },
    settle: () => turn(settled(store.get().history)),
    undo: () => turn(undone(store.get().history)),
    redo: () => turn(redone(store.get().history)),
    // All steps since a history become one.
    collapse({ past, present: before }) {
      const { history } = store.get();
      if (history.present !== before) store.set({ history: { past: [...past, before], present: history.present, future: [], gesture: null } });
    },
    remember(document, samples, chosen) {
      results.set(document, { samples, chosen });
    },
    // Whether there is nothing to make of a document.
    knows(document, quality) {
      const known = results.get(document);
      return Boolean(known) && (quality === "preview" || known.samples.every(({ steps }) => steps !== "preview"));
    },
    choose(key) {
      store.set({ chosen: key });
      if (results.has(present())) results.set(present(), { samples: store.get().samples, chosen: key });
    },
    // Another document from its content; its history starts over.
    load(document, rest) {
      const { model, characters } = store.get();
      store.set({ ...INITIAL, model, characters, auto: store.get().auto, ...rest, history: historyOf(document) });
      if (rest.samples?.length) results.set(document, { samples: rest.samples, chosen: rest.chosen });
    },
  };
  return studio;
}
