// Random edits of the studio's document, and what is wrong afterwards. `state`: the module of that name; the same
// `seed` gives the same edits.
((state, seed, count) => {
  let next = seed;
  const random = () => {
    next = (Math.imul(next, 1664525) + 1013904223) >>> 0;
    return next / 2 ** 32;
  };
  const below = (most) => Math.floor(random() * most);
  const one = (list) => list[below(list.length)];
  const time = () => 30 * random();
  const parts = () => state.PARTS.filter(() => random() < 0.4);
  const text = () => one(["walk", "  jump  ", "wave", "bow", "turn left", "", " "]);
  const of = {
    add: () => ({ text: text(), start: time() - 1, end: time(), parts: parts(), track: below(6) - 1 }),
    place: (id) => ({ id, start: time() - 1, end: time(), ...(random() < 0.7 ? { track: below(6) - 1 } : {}) }),
    split: (id) => ({ id, at: time() }),
    write: (id) => ({ id, text: text() }),
    claim: (id) => ({ id, parts: parts() }),
    lockPart: () => ({ part: one(state.PARTS) }),
    lockSpan: () => ({ start: time(), end: time() }),
    unlockSpan: (id, { locks }) => ({ start: one(locks.spans)?.start ?? 0 }),
    lockGaps: () => ({ on: random() < 0.5 }),
    set: () => ({ name: one(["clean_feet", "guidance"]), value: one([false, true, 1, null]) }),
    constrain: () => ({ constraint: { kind: "hold", joint: "left_hand", start: time(), end: null } }),
    wear: () => ({ change: one([{ character: null }, { character: { id: "a1", name: "hero" } }, { materials: one(state.MATERIALS) }]) }),
    follow: (id, { prompts }) => ({
      prompts: prompts.filter(() => random() < 0.3).map((prompt) => ({ ...prompt, end: state.rounded(prompt.end + 5 * random()) })),
      without: prompts.filter(() => random() < 0.1).map((prompt) => prompt.id),
    }),
    name: () => ({ name: text() }),
    seeds: () => ({ seeds: Array.from({ length: 1 + below(6) }, () => below(1000) - 5) }),
    open: () => ({ timeline: { name: "another", prompts: Array.from({ length: below(8) }, () => ({ ...of.add(), text: "sit" })) } }),
  };
  const NEED_PROMPT = ["place", "split", "duplicate", "remove", "write", "claim", "lockPrompt"];
  const NEED_CONSTRAINT = ["adjust", "release"];

  function randomEdit(document) {
    for (;;) {
      const kind = document.prompts.length > 24 && random() < 0.5 ? "remove" : one(state.KINDS);
      if (kind === "open" && random() < 0.97) continue; // or no document would ever grow
      const list = NEED_CONSTRAINT.includes(kind) ? document.constraints : document.prompts;
      if ((NEED_PROMPT.includes(kind) || NEED_CONSTRAINT.includes(kind)) && !list.length) continue;
      const id = one(list)?.id;
      return { kind, id, ...(kind === "adjust" ? { change: { start: time() } } : of[kind]?.(id, document)) };
    }
  }

  const written = JSON.stringify;
  const problems = [];
  const check = (holds, sentence) => !holds && problems.length < 5 && problems.push(sentence);

  const beginning = state.emptyDocument();
  let history = state.historyOf(beginning);
  let kinds = new Set();
  let gesture = null;
  for (let edit = 0; edit < count; edit++) {
    if (random() < 0.1) history = state.undone(history);
    else if (random() < 0.08) history = state.redone(history);
    else {
      const { past, present } = history;
      gesture = random() < 0.15 ? gesture ?? `g${edit}` : null;
      if (gesture === null) history = state.settled(history);
      const base = gesture !== null && history.gesture === gesture ? past.at(-1) : present;
      const chosen = randomEdit(base);
      const before = written(base);
      history = state.done(history, chosen, gesture);
      kinds.add(chosen.kind);
      check(written(base) === before, `${chosen.kind} changes the document before it in place`);
    }
    for (const problem of state.problems(history.present)) check(false, `edit ${edit}: ${problem}`);
  }
  history = state.settled(history);
  while (history.future.length) history = state.redone(history); // where the last edits were undone
  const end = history.present;

  // The same timeline made at once, prompt by prompt in its order.
  let atOnce = state.emptyDocument();
  for (const prompt of end.prompts) atOnce = state.edited(atOnce, { ...prompt, kind: "add" });
  const bare = ({ prompts }) => prompts.map(({ text, start, end, parts, track }) => ({ text, start, end, parts, track }));
  check(written(bare(atOnce)) === written(bare(end)), "the end is not the same timeline made at once");
  const read = state.documentOfTimeline(state.timelineOf(end));
  const sorted = (prompts) => written(prompts.map(({ track, ...prompt }) => prompt).sort((a, b) => (written(a) < written(b) ? -1 : 1)));
  check(sorted(bare(read)) === sorted(bare(end)), "the timeline that is read again has other prompts");
  const again = state.restored(JSON.parse(written(end)));
  check(written(again) === written(end), "the document that is restored is another one");

  const steps = history.past.length;
  while (history.past.length) history = state.undone(history);
  check(history.present === beginning, "undoing all does not lead to the beginning");
  while (history.future.length) history = state.redone(history);
  check(history.present === end, "redoing all does not lead to the end");
  return { problems, steps, prompts: end.prompts.length, untried: state.KINDS.filter((kind) => !kinds.has(kind)) };
})
