// Keeps documents: on the server soon after each edit, in this browser while the server is away, and asks where another
// tab has changed the same document. Knows contents and versions; knows no elements.

import * as server from "./server.js";
import { emptyDocument, restored, titleOf } from "./state.js";

const SAVE_AFTER = 600; // milliseconds
const AGAIN_AFTER = 3000;
const PLACE = "stmc-studio/";

function recall(id) {
  try {
    return JSON.parse(localStorage.getItem(PLACE + id));
  } catch {
    return null;
  }
}

function keep(id, value) {
  try {
    localStorage.setItem(PLACE + id, JSON.stringify(value));
    localStorage.setItem(`${PLACE}last`, JSON.stringify(id));
  } catch {
    // a browser that keeps nothing, or is full: the server has it
  }
}

const freshId = () => Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16).padStart(2, "0")).join("");

// `conflict(theirs)` asks what to do: "mine", "theirs" or "both".
export function createSaving(studio, conflict) {
  const { store } = studio;
  const writer = freshId(); // whose edits these are: a save that is on its way when a page is left is no other tab's
  let version = 0; // of the server's copy that ours is an edit of
  let timer = null;
  let busy = false;
  let saved = null; // the content that is on the server
  let unsaved = false; // whether this browser keeps another one
  let loading = false;

  const contentOf = ({ history, samples, chosen, favourites, auto, quality }) => ({
    format: 1, writer, name: titleOf(history.present), document: history.present, samples, chosen, favourites, settings: { auto, quality },
  });
  const written = () => JSON.stringify(contentOf(store.get()));

  const worth = ({ history, samples }) => history.past.length + history.present.prompts.length + samples.length > 0;

  function take(id, content, base) {
    const document = restored(content?.document);
    version = base;
    loading = true;
    const { samples = [], chosen = null, favourites = [], settings = {} } = document ? content : {};
    studio.load(document ?? emptyDocument(), { id, samples, chosen, favourites, ...settings });
    saved = base ? written() : null;
    loading = false;
    keep(id, { base, content: contentOf(store.get()), dirty: false });
    if (location.hash !== `#${id}`) history.replaceState(null, "", `#${id}`);
  }

  async function push() {
    clearTimeout(timer);
    const { id } = store.get();
    const now = written();
    if (busy || id === null || now === saved || (!version && !worth(store.get()))) return;
    busy = true;
    store.set({ saved: "saving" });
    try {
      const answer = await server.saveDocument(id, version, JSON.parse(now));
      if (store.get().id === id) {
        version = answer.version;
        saved = now;
        keep(id, { base: version, content: JSON.parse(now), dirty: false });
        store.set({ saved: "saved" });
      }
    } catch (error) {
      if (error.status === 409) await settle(error.data);
      else {
        store.set({ saved: error.status === 401 ? "stranger" : "away" });
        timer = setTimeout(push, AGAIN_AFTER);
      }
    }
    busy = false;
    if (written() !== saved && store.get().saved === "saved") timer = setTimeout(push, SAVE_AFTER);
  }

  // Where nobody would lose an edit nobody is asked: of the same document the motions that came last count, and a tab that
  // has changed nothing since it last agreed with the server takes what is there.
  function unasked(theirs) {
    const there = JSON.stringify(theirs.content.document);
    const ours = JSON.stringify(store.get().history.present);
    if (there === ours) return "mine";
    return saved !== null && ours === JSON.stringify(JSON.parse(saved).document) ? "theirs" : null;
  }

  // Somebody else's version is newer.
  async function settle(theirs) {
    let choice = unasked(theirs);
    if (!choice) {
      store.set({ saved: "conflict" });
      choice = await conflict(theirs);
    }
    if (choice === "theirs") return take(store.get().id, theirs.content, theirs.version);
    if (choice === "both") {
      const copy = contentOf(store.get());
      const id = freshId();
      take(id, { ...copy, document: { ...copy.document, name: `${copy.document.name} (copy)`.slice(0, 120) } }, 0);
    } else version = theirs.version;
    saved = null;
    store.set({ saved: "saved" });
    timer = setTimeout(push);
  }

  store.subscribe(({ id }) => {
    if (loading || id === null) return;
    const dirty = written() !== saved;
    if (!dirty && !unsaved) return;
    unsaved = dirty; // an edit that was undone leads back to what the server has
    keep(id, { base: version, content: contentOf(store.get()), dirty });
    if (!dirty || store.get().saved === "conflict") return;
    clearTimeout(timer);
    timer = setTimeout(push, SAVE_AFTER);
  });

  return {
    // Of the document as it was left: what a crash kept from the server comes from this browser.
    async open(id) {
      await push().catch(() => {});
      const local = recall(id);
      const theirs = await server.openDocument(id).catch((error) => (error.status === 404 ? null : { away: true }));
      if (theirs?.away || !theirs) return take(id, local?.content, 0);
      if (!local?.dirty) return take(id, theirs.content, theirs.version);
      take(id, local.content, local.base);
      saved = null;
      const ours = local.base === theirs.version || theirs.content.writer === local.content.writer;
      if (!ours) return settle(theirs);
      version = theirs.version;
      return push();
    },
    create(content = null) {
      take(freshId(), content, 0);
    },
    last: () => recall("last"),
    push,
  };
}
