// The body parts that a prompt's action needs: those that the prompt does not claim, and those that another prompt has. Knows
// what the server says of a timeline: `owners`, for each body part [[prompt id or null, start, end], …], and of each prompt
// its `parts` and what it `needs`. Knows no elements.

import { PARTS } from "./state.js";

const SHORTEST = 0.1; // seconds; less is an end that is rounded to a frame

// What a prompt should claim besides, where it claims nothing that its action needs.
export const missingParts = ({ parts, needs }) => (needs.some((part) => parts.includes(part)) ? [] : needs);

// What other prompts have of the parts that a prompt lists, or that its action needs: [{id, parts, start, end}].
export function lostParts({ id, start, end, parts: listed }, { parts, needs }, owners) {
  const lost = new Map();
  for (const part of PARTS.filter((part) => parts.includes(part) && (listed.includes(part) || needs.includes(part))))
    for (const [owner, from, to] of owners[part] ?? []) {
      const [first, last] = [Math.max(start, from), Math.min(end, to)];
      if (owner === null || owner === id || last - first < SHORTEST) continue;
      const before = lost.get(owner) ?? { id: owner, parts: [], start: first, end: last };
      lost.set(owner, {
        id: owner, parts: before.parts.includes(part) ? before.parts : [...before.parts, part],
        start: Math.min(before.start, first), end: Math.max(before.end, last),
      });
    }
  return [...lost.values()].sort((one, other) => one.start - other.start);
}

// Why another prompt has them, as the rule of timelines says.
export const reason = (own, other) => ({ "-1": ", because it claims fewer body parts", 0: ", because it comes later in the list" }[Math.sign(other - own)] ?? "");

// "the legs and the spine"
export function named(parts) {
  const names = parts.map((part) => `the ${part}`);
  return names.length < 2 ? names.join() : `${names.slice(0, -1).join(", ")} and ${names.at(-1)}`;
}
