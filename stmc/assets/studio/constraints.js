// What constraints are called, when they hold, and when a motion meets them. The server describes each kind (`describe` in
// stmc/editing/constraints/constraint.py): nothing here knows one by its name. Knows no page.

import { written } from "./times.js";

const kinds = new Map();
export const learn = (described) => described.forEach((kind) => kinds.set(kind.name, kind));
export const kindOf = (name) => kinds.get(name) ?? { name, title: name, about: "", tolerance: Infinity, open_end: "end", fields: [] };
export const fieldOf = (kind, control) => kindOf(kind).fields.find((field) => field.control === control);
const valueOf = (constraint, control) => constraint[fieldOf(constraint.kind, control)?.name];

export const jointOf = (constraint) => valueOf(constraint, "joint");

export const said = (joint) => joint.replace("_", " ");
export const degrees = (angle) => Math.round((angle * 180) / Math.PI);

// Seconds from and to which a constraint holds, in a motion of so many seconds.
export function spanOf(constraint, duration) {
  const moment = valueOf(constraint, "moment");
  if (moment !== undefined) return { start: moment, end: moment };
  const start = valueOf(constraint, "start") ?? 0;
  const open = kindOf(constraint.kind).open_end === "start" ? start : Math.max(start, duration);
  return { start, end: valueOf(constraint, "end") ?? open };
}

function turned(angle) {
  const left = degrees(angle);
  return left ? ` ${Math.abs(left)}° to the ${left > 0 ? "left" : "right"}` : " as at the start";
}

const whole = (seconds) => written(seconds).replace(" ", "\u00a0"); // not torn at a line's end

export function titleOf(constraint) {
  const [joint, angle] = [valueOf(constraint, "joint"), valueOf(constraint, "angle")];
  const what = `${kindOf(constraint.kind).title}${joint ? ` of the ${said(joint)}` : ""}${angle === undefined ? "" : turned(angle)}`;
  const { start, end } = spanOf(constraint, Infinity);
  if (end === start) return `${what}, at ${whole(start)}`;
  return `${what}, ${whole(start)} to ${end === Infinity ? "the end" : whole(end)}`;
}

// Metres along a line.
export const lengthOf = (points) => points.slice(1).reduce((sum, [x, y], index) => sum + Math.hypot(x - points[index][0], y - points[index][1]), 0);

// How fast a path has to be walked: "2.4 m in 4 s: 0.6 m/s".
export function paceOf({ points, start, end }, duration) {
  const metres = lengthOf(points);
  const seconds = Math.max(0.05, (end ?? duration) - start);
  return `${metres.toFixed(1)} m in ${whole(seconds)}: ${(metres / seconds).toFixed(1)} m/s`;
}

// How far a sample is from a constraint as it is now: {error, unit, …}, or undefined where it was made for another one.
export const demandOf = (sample, constraint) => sample?.demands.find(({ of }) => JSON.stringify(of) === JSON.stringify(constraint));
export const meets = ({ kind }, { error }) => error <= kindOf(kind).tolerance;
export const errorOf = ({ error, unit }) => `${error.toFixed(1)}${unit === "degrees" ? "°" : " cm"}`;
