// The film that the server draws: how far it is, and its end. Knows the elements of the export dialog and the server's jobs;
// knows no motions.

import * as server from "./server.js";
import { find } from "./dom.js";

let busy = false;

export const drawsFilm = () => busy;

// The film of a motion as a blob. It ends with an error if the film fails or is cancelled, as it is if the page is closed:
// nobody would save it.
export async function drawFilm(request) {
  busy = true;
  paint({ step: 0, steps: 0 });
  const following = new AbortController();
  try {
    const { job } = await server.startFilm(request);
    addEventListener("pagehide", () => server.cancelJob(job).catch(() => {}), { signal: following.signal });
    find("film").hidden = false;
    const { kind, data } = await new Promise((end) => {
      const stop = server.followJob(job, (kind, data) => (kind === "progress" ? paint(data) : end({ kind, data })));
      find("film-cancel").disabled = false;
      find("film-cancel").onclick = () => cancel(job, () => {
        stop();
        end({ kind: "cancelled" });
      });
    });
    if (kind === "done") return await server.filmFile(job);
    throw new Error({ failed: () => server.sentence(data.error), lost: () => "The studio was started again meanwhile. Save the film once more." }[kind]?.() ?? "Cancelled.");
  } finally {
    following.abort();
    busy = false;
    find("film").hidden = true;
  }
}

// Where the server is away, the button can be pressed again.
async function cancel(job, done) {
  find("film-cancel").disabled = true;
  try {
    await server.cancelJob(job);
    done();
  } catch (error) {
    if (error.status === 0) find("film-cancel").disabled = false;
    else done();
  }
}

// Behind the last picture the file is written, which has no steps.
export function filmText({ step, steps }) {
  if (!steps) return "Waiting";
  return step < steps ? `${Math.floor((100 * step) / steps)} %` : "Writing the file";
}

function paint(progress) {
  const text = filmText(progress), bar = find("film-bar");
  bar.firstChild.style.width = `${(100 * progress.step) / (progress.steps || 1)}%`;
  bar.setAttribute("aria-valuemax", progress.steps || 1);
  bar.setAttribute("aria-valuenow", progress.step);
  bar.setAttribute("aria-valuetext", text);
  find("film-text").textContent = text;
}
