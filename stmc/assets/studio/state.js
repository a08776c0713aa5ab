// The document of the studio: prompts on tracks, constraints, locks; the edits of it, and its history. Pure functions of
// plain values that are never changed in place, so that a document of long ago is still what it was. Knows no page.

export const SHORTEST = 0.1; // seconds of the shortest prompt
export const GRID = 0.1; // seconds
export const MOST_SAMPLES = 4;
export const MATERIALS = ["prompts", "own"]; // what a character wears: the colours of prompts, or its own materials
export const PARTS = ["left arm", "right arm", "legs", "head", "spine"];

export const rounded = (seconds) => Math.round(seconds * 1000) / 1000;

const UNTITLED = "Untitled";

// By which a document is found again: its own name, or else its first prompt.
export const titleOf = ({ name, prompts }) => (name === UNTITLED && prompts.length ? prompts[0].text.slice(0, 60) : name);

export function emptyDocument(name = UNTITLED) {
  return {
    name,
    next: 1, // of the ids that are still to be given
    prompts: [],
    constraints: [],
    locks: { parts: [], spans: [], gaps: false },
    seeds: [0],
    figure: { character: null, materials: "prompts" }, // who moves: {id, name} of a character, or null: the mannequin
    settings: { clean_feet: true }, // of a request, as the server names them; what is not here is the model's own
  };
}

// ---- asking -----------------------------------------------------------------------------------------------------------

export const duration = (document) => document.prompts.reduce((latest, { end }) => Math.max(latest, end), 0);
export const trackCount = (document) => document.prompts.reduce((count, { track }) => Math.max(count, track + 1), 0);
export const promptOf = (document, id) => document.prompts.find((prompt) => prompt.id === id) ?? null;

// The prompts as the server has them. Lower tracks come later, and so win where two prompts claim the same body part.
export function timelineOf(document) {
  const prompts = document.prompts.map(({ text, start, end, parts }) => ({ text, start, end, parts }));
  return { name: document.name, prompts };
}

const together = (one, other) => one.start < other.end && other.start < one.end;

function freeTrack(prompts, { id, start, end }, wanted) {
  const near = prompts.filter((other) => other.id !== id && together({ start, end }, other));
  let track = Math.max(0, wanted);
  while (near.some((other) => other.track === track)) track++;
  return track;
}

function freeColour(prompts) {
  const used = new Set(prompts.map(({ colour }) => colour));
  let colour = 0;
  while (used.has(colour)) colour++;
  return colour;
}

// In the timeline's order, on tracks without holes between them.
function arranged(prompts) {
  const used = [...new Set(prompts.map(({ track }) => track))].sort((one, other) => one - other);
  const number = new Map(used.map((track, index) => [track, index]));
  return prompts
    .map((prompt) => (number.get(prompt.track) === prompt.track ? prompt : { ...prompt, track: number.get(prompt.track) }))
    .sort((one, other) => one.track - other.track || one.start - other.start);
}

// ---- edits ------------------------------------------------------------------------------------------------------------

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const words = (text) => text.split(/\s+/).filter(Boolean).join(" ");
const span = (start, end) => {
  const from = rounded(Math.max(0, start));
  return { start: from, end: rounded(Math.max(end, from + SHORTEST)) };
};
const ordered = (parts) => PARTS.filter((part) => parts.includes(part));
const replaced = (list, id, change) => list.map((item) => (item.id === id ? { ...item, ...change } : item));

function withPrompt(document, prompt, track) {
  const fresh = { ...prompt, id: `p${document.next}`, colour: freeColour(document.prompts) };
  fresh.track = freeTrack(document.prompts, fresh, track);
  return { ...document, next: document.next + 1, prompts: arranged([...document.prompts, fresh]) };
}

function placed(document, id, times, track) {
  const before = promptOf(document, id);
  const after = { ...before, ...times };
  after.track = freeTrack(document.prompts, after, track);
  if (after.start === before.start && after.end === before.end && after.track === before.track) return document;
  return { ...document, prompts: arranged(document.prompts.map((prompt) => (prompt.id === id ? after : prompt))) };
}

const EDITS = {
  add(document, { text, start, end, parts = [], track = 0 }) {
    if (!words(text)) return document;
    return withPrompt(document, { text: words(text), ...span(start, end), parts: ordered(parts), locked: false }, track);
  },
  // Moves, stretches, or both; to the next track that is free where the wanted one is not.
  place(document, { id, start, end, track }) {
    return placed(document, id, span(start, end), track ?? promptOf(document, id).track);
  },
  split(document, { id, at }) {
    const prompt = promptOf(document, id);
    const time = rounded(at);
    if (time < prompt.start + SHORTEST || time > prompt.end - SHORTEST) return document;
    const first = { ...document, prompts: replaced(document.prompts, id, { end: time }) };
    return withPrompt(first, { ...prompt, start: time }, prompt.track);
  },
  duplicate(document, { id }) {
    const prompt = promptOf(document, id);
    const length = prompt.end - prompt.start;
    return withPrompt(document, { ...prompt, ...span(prompt.end, prompt.end + length), locked: false }, prompt.track);
  },
  remove(document, { id }) {
    return { ...document, prompts: arranged(document.prompts.filter((prompt) => prompt.id !== id)) };
  },
  write(document, { id, text }) {
    if (!words(text) || words(text) === promptOf(document, id).text) return document;
    return { ...document, prompts: replaced(document.prompts, id, { text: words(text) }) };
  },
  claim(document, { id, parts }) {
    return { ...document, prompts: replaced(document.prompts, id, { parts: ordered(parts) }) };
  },
  lockPrompt(document, { id }) {
    return { ...document, prompts: replaced(document.prompts, id, { locked: !promptOf(document, id).locked }) };
  },
  lockPart(document, { part }) {
    const { parts } = document.locks;
    const next = parts.includes(part) ? parts.filter((other) => other !== part) : [...parts, part];
    return { ...document, locks: { ...document.locks, parts: ordered(next) } };
  },
  lockSpan(document, { start, end }) {
    return { ...document, locks: { ...document.locks, spans: merged([...document.locks.spans, span(start, end)]) } };
  },
  unlockSpan(document, { start }) {
    const spans = document.locks.spans.filter((locked) => locked.start !== start);
    return { ...document, locks: { ...document.locks, spans } };
  },
  lockGaps(document, { on }) {
    return { ...document, locks: { ...document.locks, gaps: on } };
  },
  constrain(document, { constraint }) {
    const fresh = { ...constraint, id: `c${document.next}` };
    return { ...document, next: document.next + 1, constraints: [...document.constraints, fresh] };
  },
  adjust(document, { id, change }) {
    return { ...document, constraints: replaced(document.constraints, id, change) };
  },
  release(document, { id }) {
    return { ...document, constraints: document.constraints.filter((constraint) => constraint.id !== id) };
  },
  name(document, { name }) {
    return name.trim() && name.trim() !== document.name ? { ...document, name: name.trim().slice(0, 120) } : document;
  },
  seeds(document, { seeds }) {
    const whole = seeds.map((seed) => clamp(Math.trunc(seed) || 0, 0, 2 ** 31 - 1));
    return { ...document, seeds: [...new Set(whole)].slice(0, MOST_SAMPLES) };
  },
  set(document, { name, value }) {
    return { ...document, settings: { ...document.settings, [name]: value } };
  },
  wear(document, { change }) {
    const figure = { ...document.figure, ...change };
    return JSON.stringify(figure) === JSON.stringify(document.figure) ? document : { ...document, figure };
  },
  // Prompts as a stream has them, in place of those of the same ids, and `without` some.
  follow(document, { prompts, without }) {
    const ids = [...without, ...prompts.map(({ id }) => id)];
    let result = document.prompts.filter(({ id }) => !ids.includes(id));
    for (const prompt of prompts) {
      const used = result.some(({ colour }) => colour === prompt.colour);
      result = [...result, { ...prompt, track: freeTrack(result, prompt, prompt.track), colour: used ? freeColour(result) : prompt.colour }];
    }
    const next = Math.max(document.next, ...prompts.map(({ id }) => Number(id.slice(1)) + 1));
    return { ...document, next, prompts: arranged(result) };
  },
  // Another timeline in place of this one.
  open(document, { timeline }) {
    return documentOfTimeline(timeline);
  },
};

export const KINDS = Object.keys(EDITS);

// The document after an edit; the very same one where there is nothing to change.
export const edited = (document, edit) => EDITS[edit.kind](document, edit);

export function merged(spans) {
  const result = [];
  for (const next of [...spans].sort((one, other) => one.start - other.start)) {
    const last = result.at(-1);
    if (last && next.start <= last.end) result[result.length - 1] = { start: last.start, end: Math.max(last.end, next.end) };
    else result.push({ ...next });
  }
  return result;
}

// A timeline on tracks: each prompt beneath all the earlier ones that it overlaps, since lower tracks come later.
export function documentOfTimeline({ name, prompts }) {
  let document = emptyDocument(name || UNTITLED);
  for (const prompt of prompts) {
    const above = document.prompts.filter((other) => together(other, prompt)).map(({ track }) => track);
    document = edited(document, { ...prompt, kind: "add", track: Math.max(-1, ...above) + 1 });
  }
  return document;
}

// ---- history ----------------------------------------------------------------------------------------------------------

export const historyOf = (document) => ({ past: [], present: document, future: [], gesture: null });

// All edits of one `gesture`, such as a drag, are one step: each starts from the document before the gesture.
export function done(history, edit, gesture = null) {
  const again = gesture !== null && history.gesture === gesture;
  const base = again ? history.past.at(-1) : history.present;
  const present = edited(base, edit);
  if (again) return { ...history, present };
  if (present === base) return history;
  return { past: [...history.past, base], present, future: [], gesture };
}

// After a gesture: it leaves no step where it led back to where it began.
export function settled(history) {
  if (history.gesture === null) return history;
  if (history.past.at(-1) === history.present) return { ...history, past: history.past.slice(0, -1), gesture: null };
  return { ...history, gesture: null };
}

export function undone(history) {
  const { past, present, future } = settled(history);
  if (!past.length) return history;
  return { past: past.slice(0, -1), present: past.at(-1), future: [present, ...future], gesture: null };
}

export function redone(history) {
  const { past, present, future } = settled(history);
  if (!future.length) return history;
  return { past: [...past, present], present: future[0], future: future.slice(1), gesture: null };
}

// ---- what holds -------------------------------------------------------------------------------------------------------

// Sentences about what does not hold; none of a document that only edits have made.
export function problems(document) {
  const found = [];
  const ids = [...document.prompts, ...document.constraints].map(({ id }) => id);
  if (new Set(ids).size < ids.length) found.push("an id is duplicated");
  if (ids.some((id) => !(Number(id.slice(1)) < document.next))) found.push("an id is still to be given");
  for (const { id, text, start, end, track, parts } of document.prompts) {
    if (!(0 <= start && start + SHORTEST <= end + 1e-9 && Number.isFinite(end))) found.push(`${id}: times are not in order`);
    if (!text || text !== words(text)) found.push(`${id}: the text is empty or untidy`);
    if (!Number.isInteger(track) || track < 0) found.push(`${id}: the track is invalid`);
    if (parts.join() !== ordered(parts).join()) found.push(`${id}: a body part is invalid`);
  }
  for (const one of document.prompts)
    if (freeTrack(document.prompts, one, one.track) !== one.track) found.push(`${one.id}: shares its track and time`);
  if (arranged(document.prompts).some((prompt, index) => prompt !== document.prompts[index])) found.push("not in order");
  if (new Set(document.prompts.map(({ colour }) => colour)).size < document.prompts.length) found.push("a colour is shared");
  const { character, materials } = document.figure;
  if (!MATERIALS.includes(materials)) found.push("the materials are unknown");
  if (character && !(/^[\w-]{1,40}$/.test(character.id) && typeof character.name === "string")) found.push("the character is invalid");
  const { spans } = document.locks;
  if (JSON.stringify(merged(spans)) !== JSON.stringify(spans)) found.push("locked spans overlap");
  return found;
}

// A document that was written to a file by a page of this kind, or null for anything else.
export function restored(data) {
  try {
    const { cleanFeet, ...rest } = data; // pages of before had this one setting, and no others
    const settings = { ...emptyDocument().settings, ...(cleanFeet === undefined ? {} : { clean_feet: cleanFeet }), ...data.settings };
    const figure = { ...emptyDocument().figure, ...data.figure };
    const document = { ...emptyDocument(), ...rest, figure, settings, locks: { ...emptyDocument().locks, ...data.locks } };
    return problems(document).length ? null : document;
  } catch {
    return null;
  }
}
