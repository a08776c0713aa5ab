// The parts of a motion to regenerate: times and body parts that nothing locks, that one prompt decides, or that an edit has
// touched. Spans are {start, end} in seconds. A `plan` is what the server says of a timeline: `owners`, for each body part
// [[prompt id or null, start, end], …], and `prompts`, by id, with the body parts that each claims.

import { spanOf } from "./constraints.js";
import { PARTS, merged } from "./state.js";

const SHORTEST = 0.02; // seconds; less is no frame
const EASE = 0.75; // seconds before and after a demand in which the body gets there, and leaves

function without(spans, taken) {
  let left = spans;
  for (const gone of taken)
    left = left.flatMap(({ start, end }) => [
      { start, end: Math.min(end, gone.start) },
      { start: Math.max(start, gone.end), end },
    ].filter((piece) => piece.end - piece.start > SHORTEST));
  return left;
}

function within(spans, bounds) {
  return spans.flatMap(({ start, end }) =>
    bounds.map((bound) => ({ start: Math.max(start, bound.start), end: Math.min(end, bound.end) }))
      .filter((piece) => piece.end - piece.start > SHORTEST));
}

// One change for each span of time, of all the parts that have it.
function joined(spansOf) {
  const changes = new Map();
  for (const part of PARTS)
    for (const { start, end } of merged(spansOf(part))) {
      const key = `${start} ${end}`;
      if (!changes.has(key)) changes.set(key, { start, end, parts: [] });
      changes.get(key).parts.push(part);
    }
  return [...changes.values()].sort((one, other) => one.start - other.start);
}

const ownedBy = (owners, part, wanted) =>
  (owners[part] ?? []).filter(([owner]) => wanted(owner)).map(([, start, end]) => ({ start, end }));

// Where gaps are kept, a prompt changes what it claims alone, though it may also own what nobody claims.
function lockedOf(document, { owners, prompts }, part, duration) {
  if (document.locks.parts.includes(part)) return [{ start: 0, end: duration }];
  const ids = new Set(document.prompts.filter(({ locked }) => locked).map(({ id }) => id));
  const gap = (owner) => document.locks.gaps && !prompts[owner]?.parts.includes(part);
  return [...document.locks.spans, ...ownedBy(owners, part, (owner) => ids.has(owner) || gap(owner))];
}

export const hasLocks = ({ prompts, locks }) =>
  locks.gaps || locks.parts.length > 0 || locks.spans.length > 0 || prompts.some(({ locked }) => locked);

// All that is not locked.
export const unlocked = (document, plan, duration) =>
  joined((part) => without([{ start: 0, end: duration }], lockedOf(document, plan, part, duration)));

// Of `wanted` (changes), what is not locked.
export const unlockedOf = (wanted, document, plan, duration) =>
  joined((part) => {
    const spans = wanted.filter(({ parts }) => parts.includes(part));
    return without(within(spans, [{ start: 0, end: duration }]), lockedOf(document, plan, part, duration));
  });

// What one prompt decides.
export const decidedBy = (id, { owners }) => joined((part) => ownedBy(owners, part, (owner) => owner === id));

// Who asks what of each body part, and what is demanded beside it, in words that compare.
export function asked(document, { owners }) {
  const says = new Map(document.prompts.map(({ id, text, start, end }) => [id, `${text} # ${start} # ${end}`]));
  const parts = Object.fromEntries(PARTS.map((part) => [
    part, (owners[part] ?? []).map(([owner, start, end]) => [says.get(owner) ?? null, start, end]),
  ]));
  return { parts, constraints: document.constraints.map(({ id, ...demand }) => demand) };
}

const around = (constraint) => {
  const { start, end } = spanOf(constraint, Infinity);
  return { start: start - EASE, end: end + EASE };
};

// Where body parts are asked for something else than `before`, or other demands are made.
export function touched(before, after) {
  const known = (list, demand) => list.some((other) => JSON.stringify(other) === JSON.stringify(demand));
  const [old, now] = [before.constraints ?? [], after.constraints];
  const demands = [...now.filter((each) => !known(old, each)), ...old.filter((each) => !known(now, each))].map(around);
  return joined((part) => [...demands, ...after.parts[part].flatMap(([says, start, end]) => {
    const same = (before.parts?.[part] ?? []).filter(([said]) => said === says);
    return without([{ start, end }], same.map(([, from, to]) => ({ start: from, end: to })));
  })]);
}
