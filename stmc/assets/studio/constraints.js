// What constraints are called, when they hold, and when a motion meets them. Pure functions; knows no page.

import { written } from "./times.js";

export const NAMES = { path: "Path", heading: "Heading", keyframe: "Keyframe", target: "Target", hold: "Hold" };
const FINE = { path: 5, target: 2, hold: 2, keyframe: 5, heading: 10 }; // centimetres (a heading: degrees)

export const said = (joint) => joint.replace("_", " ");
export const degrees = (angle) => Math.round((angle * 180) / Math.PI);

// Seconds from and to which a constraint holds, in a motion of so many seconds.
export function spanOf({ kind, start, end, at }, duration) {
  if (kind === "keyframe") return { start: at, end: at };
  return { start, end: end ?? (kind === "target" ? start : Math.max(start, duration)) };
}

function turned(angle) {
  const left = degrees(angle);
  return left ? ` ${Math.abs(left)}° to the ${left > 0 ? "left" : "right"}` : " as at the start";
}

const whole = (seconds) => written(seconds).replace(" ", "\u00a0"); // not torn at a line's end

export function titleOf({ kind, joint, angle, start, end, at }) {
  const what = `${NAMES[kind]}${joint ? ` of the ${said(joint)}` : ""}${angle === undefined ? "" : turned(angle)}`;
  const until = end ?? (kind === "target" ? start : null);
  if (kind === "keyframe" || until === start) return `${what}, at ${whole(at ?? start)}`;
  return `${what}, ${whole(start)} to ${until === null ? "the end" : whole(until)}`;
}

// How fast a path has to be walked: "2.4 m in 4 s: 0.6 m/s".
export function paceOf({ points, start, end }, duration) {
  const metres = points.slice(1).reduce((sum, [x, y], index) => sum + Math.hypot(x - points[index][0], y - points[index][1]), 0);
  const seconds = Math.max(0.05, (end ?? duration) - start);
  return `${metres.toFixed(1)} m in ${whole(seconds)}: ${(metres / seconds).toFixed(1)} m/s`;
}

// How far a sample is from a constraint as it is now: {error, unit, …}, or undefined where it was made for another one.
export const demandOf = (sample, constraint) => sample?.demands.find(({ of }) => JSON.stringify(of) === JSON.stringify(constraint));
export const meets = ({ kind }, { error }) => error <= FINE[kind];
export const errorOf = ({ error, unit }) => `${error.toFixed(1)}${unit === "degrees" ? "°" : " cm"}`;
