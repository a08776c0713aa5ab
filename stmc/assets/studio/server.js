// Speaks with the server. Knows addresses, headers and how to wait for a server that is away; knows no page.

// What shows that this page was opened by whoever started the studio. It is kept by this browser for this address alone:
// a cookie would go to every server of this machine.
const KEY = "stmc-studio-key";
const AGAIN_AFTER = 1000; // milliseconds
const ENDS = ["done", "failed", "cancelled"];
let key = null;
try {
  key = localStorage.getItem(KEY);
} catch {
  // a browser that keeps nothing: the key lasts as long as the page
}

export const sentence = (text) => text.charAt(0).toUpperCase() + text.slice(1) + (text.endsWith(".") ? "" : ".");

export class ServerError extends Error {
  constructor(status, data) {
    super(sentence(data.error ?? `the server answered ${status}`));
    this.status = status; // 0: it did not answer
    this.data = data;
  }
}

async function answered(path, options = {}) {
  let response;
  try {
    response = await fetch(path, { cache: "no-store", ...options, headers: { Authorization: `Bearer ${key ?? ""}`, ...options.headers } });
  } catch {
    throw new ServerError(0, { error: "the server does not answer" });
  }
  if (response.ok) return response;
  const data = await response.json().catch(() => ({}));
  throw new ServerError(response.status, data);
}

const json = async (path, options) => (await answered(path, options)).json();
const unsafe = (method, data) => ({
  method,
  headers: data === undefined ? {} : { "Content-Type": "application/json" },
  body: data === undefined ? undefined : JSON.stringify(data),
});

// Takes the token out of the page's address, which can be opened once, for the key. Where it was used before, a page of
// the same browser still has the key.
export async function enter() {
  const token = new URLSearchParams(location.hash.slice(1)).get("token");
  if (!token) return;
  try {
    ({ key } = await json("/api/session", unsafe("POST", { token })));
  } catch (error) {
    if (error.status !== 401) throw error;
  }
  history.replaceState(null, "", location.pathname);
  try {
    localStorage.setItem(KEY, key ?? "");
  } catch {
    // see above
  }
}

export const askModel = () => json("/api/model");
export const check = (timeline, signal) => json("/api/check", { ...unsafe("POST", { timeline }), signal });
export const readTimelines = (name, text) => json("/api/read", unsafe("POST", { name, text }));
export const writeTimeline = async (timeline, format) =>
  (await answered("/api/write", unsafe("POST", { timeline, format }))).text();

export const uploadMotion = (file) =>
  json("/api/motions", { method: "POST", headers: { "X-Filename": encodeURIComponent(file.name) }, body: file });

export const listCharacters = async () => (await json("/api/characters")).characters;
export const addCharacter = async (file) =>
  (await json("/api/characters", { method: "POST", headers: { "X-Filename": encodeURIComponent(file.name) }, body: file })).character;
export const deleteCharacter = (id) => answered(`/api/characters/${encodeURIComponent(id)}`, unsafe("DELETE"));
export const jointMap = (id) => json(`/api/characters/${encodeURIComponent(id)}/joint_map`);
export const correctJoints = (id, joint_map) => json(`/api/characters/${encodeURIComponent(id)}/joint_map`, unsafe("PUT", { joint_map }));
const bytes = async (path) => (await answered(path)).arrayBuffer();
export const characterFile = (id) => bytes(`/api/characters/${encodeURIComponent(id)}`);
export const posesFile = (id, motion) => bytes(`/api/characters/${encodeURIComponent(id)}/poses/${encodeURIComponent(motion)}`);

export const motionFile = async (id, extension, settings = {}) => {
  const query = new URLSearchParams(settings).toString();
  return (await answered(`/api/motions/${encodeURIComponent(id)}.${extension}${query && "?" + query}`)).blob();
};

export const startFilm = (request) => json("/api/films", unsafe("POST", request));
export const filmFile = async (job) => (await answered(`/api/films/${encodeURIComponent(job)}`)).blob();

export const listDocuments = async () => (await json("/api/documents")).documents;
export const openDocument = (id) => json(`/api/documents/${encodeURIComponent(id)}`);
export const saveDocument = (id, base, content) => json(`/api/documents/${encodeURIComponent(id)}`, unsafe("PUT", { base, content }));
export const deleteDocument = (id) => answered(`/api/documents/${encodeURIComponent(id)}`, unsafe("DELETE"));

export const startJob = (request) => json("/api/jobs", unsafe("POST", request));
export const cancelJob = (id) => answered(`/api/jobs/${encodeURIComponent(id)}`, { ...unsafe("DELETE"), keepalive: true });

export const openStream = (request) => json("/api/streams", unsafe("POST", request));
export const readStream = (id, edits, frames) => json(`/api/streams/${encodeURIComponent(id)}`, unsafe("POST", { edits, frames }));
export const closeStream = (id) => answered(`/api/streams/${encodeURIComponent(id)}`, { ...unsafe("DELETE"), keepalive: true });
export const mannequinFile = () => bytes("/api/mannequin.glb");

// Tells what happens in a job: `hear(kind, data)`. Returns what stops listening. A connection that breaks is taken up
// again; where the server knows the job no more, it is "lost".
export function followJob(id, hear) {
  const stop = new AbortController();
  const { signal } = stop;
  async function listen() {
    const response = await answered(`/api/jobs/${encodeURIComponent(id)}/events`, { signal });
    for await (const { kind, data } of eventsOf(response.body)) {
      if (signal.aborted) return true;
      hear(kind, data);
      if (ENDS.includes(kind)) return true;
    }
    return false;
  }
  (async () => {
    while (!signal.aborted) {
      try {
        if (await listen()) return;
      } catch (error) {
        if (error.status && !signal.aborted) return hear("lost", {});
      }
      await new Promise((resolve) => setTimeout(resolve, AGAIN_AFTER));
    }
  })();
  return () => stop.abort();
}

// Server-sent events as they come: "event: kind", "data: json", an empty line.
async function* eventsOf(body) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    const blocks = (text + value).split("\n\n");
    text = blocks.pop();
    for (const block of blocks) {
      const [kind, data] = block.split("\n").map((line) => line.slice(line.indexOf(": ") + 2));
      yield { kind, data: JSON.parse(data) };
    }
  }
}
