// Seconds on a page: snapping, marks of a ruler, how they are written.

import { GRID, rounded } from "./state.js";

// The nearest of `marks` within `reach` seconds, else the nearest tenth of a second.
export function snapped(time, marks, reach) {
  let best = null;
  for (const mark of marks)
    if (Math.abs(mark - time) <= reach && (best === null || Math.abs(mark - time) < Math.abs(best - time))) best = mark;
  return rounded(best ?? Math.round(time / GRID) * GRID);
}

// A shift of both ends by which one of them snaps: to a mark where one is near, else the start to the grid.
export function snappedShift(start, end, marks, reach) {
  const shifts = [start, end].map((time) => ({ time, to: snapped(time, marks, reach) }));
  const near = shifts.filter(({ to }) => marks.some((mark) => Math.abs(mark - to) < 1e-6));
  const best = near.sort((one, other) => Math.abs(one.to - one.time) - Math.abs(other.to - other.time))[0] ?? shifts[0];
  return best.to - best.time;
}

// Seconds between the numbers of a ruler with so many pixels a second.
export const rulerStep = (scale) => [0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600].find((step) => step * scale >= (step < 1 ? 90 : 40)) ?? 1200;

export const written = (seconds) => `${rounded(seconds).toFixed(seconds % 1 ? (Math.round(seconds * 100) % 10 ? 2 : 1) : 0)} s`;

export const clock = (seconds) => seconds.toFixed(2);
