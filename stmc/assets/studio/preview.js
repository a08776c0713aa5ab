// Which samples stand on the stage: fetches their figures, names their views, pins favourites. Knows the server's motions
// and the stage; knows no jobs.

import * as server from "./server.js";
import { button, find, keyed, make, roomStyle, say, watch } from "./dom.js";
import { characterOf } from "./character.js";
import { figureOf } from "./figure.js";

const MOST_KEPT = 24; // figures' files, in memory

// Once the stage, of whose picture the frame may have been asked for already, has drawn what it is given now.
const afterPicture = (act) => requestAnimationFrame(() => requestAnimationFrame(act));

export function createPreview(studio, stage) {
  const { store } = studio;
  const files = new Map(); // motion id, with a character's look before it where it moves one → bytes
  let figures = new Map(); // motion id → figure, of those on the stage
  let asked = 0;
  let dressed = null; // the look of the character that the figures show
  let character = null; // {look, file: a promise of the character}, the last that was shown
  let known = new Set(); // looks of the server's characters
  const broken = new Set(); // ids of characters that cannot be shown

  // A character with its joint map: by both its poses are made, and its vertices told to body parts.
  const lookOf = ({ id, corrections = {} }) => `${id} ${JSON.stringify(corrections)}`;

  async function bytesOf(id, read) {
    const known = files.get(id);
    files.delete(id);
    const bytes = known ?? (await read());
    files.set(id, bytes); // the latest last
    if (files.size > MOST_KEPT) files.delete(files.keys().next().value);
    return bytes;
  }

  const mannequin = async (motion) =>
    figureOf(await bytesOf(motion.id, async () => (await server.motionFile(motion.id, "glb")).arrayBuffer()));

  function characterFor({ id }, look) {
    if (character?.look === look) return character.file;
    character?.file.then((old) => old.dispose(), () => {});
    character = { look, file: server.characterFile(id).then(characterOf) };
    return character.file;
  }

  // Who cannot be shown is told once; the mannequin does the motion instead.
  async function figureFor(motion, worn) {
    if (!worn || broken.has(worn.id)) return mannequin(motion);
    try {
      const look = lookOf(worn);
      const file = await characterFor(worn, look);
      return await file.figure(await bytesOf(`${look}/${motion.id}`, () => server.posesFile(worn.id, motion.id)));
    } catch (error) {
      if (error.status === 0) throw error; // the server is away
      broken.add(worn.id);
      character = null;
      say(`${worn.name} cannot be shown: ${error.message} The mannequin moves instead.`);
      return mannequin(motion);
    }
  }

  async function show({ samples, chosen, history }) {
    const number = ++asked;
    const next = new Map();
    const worn = studio.worn();
    const shown = () => (worn && !broken.has(worn.id) ? lookOf(worn) : null);
    const [wanted, same] = [shown(), dressed === shown()];
    find("stage").setAttribute("aria-busy", "true");
    for (const { motion } of samples) {
      try {
        next.set(motion.id, (same && figures.get(motion.id)) || (await figureFor(motion, worn)));
      } catch (error) {
        if (error.status === 404) return forget(motion.id);
        say(`The motion cannot be shown: ${error.message}`);
      }
      if (number !== asked) { // others are wanted meanwhile
        for (const [id, figure] of next) if (figures.get(id) !== figure) figure.dispose();
        return;
      }
    }
    const gone = [...figures].filter(([id, figure]) => next.get(id) !== figure).map(([, figure]) => figure);
    afterPicture(() => gone.forEach((figure) => figure.dispose())); // the next ones share their shaders
    [figures, dressed] = [next, shown()];
    if (dressed !== wanted) return show(store.get()); // some of them are figures of a character that broke
    wear(history.present.figure);
    stage.show(samples.filter(({ motion }) => next.has(motion.id)).map(({ key, motion }) => ({ key, figure: next.get(motion.id) })), chosen);
    for (const figure of next.values()) figure.paintWay(roomStyle().way);
    label();
    find("stage").setAttribute("aria-busy", "false");
    document.body.dataset.shown = samples.map(({ motion }) => motion.id).join(" ");
    document.body.dataset.figure = dressed ? worn.id : "mannequin";
  }

  function wear({ materials }) {
    for (const figure of figures.values()) figure.wear?.(materials);
    stage.refresh();
  }

  // A restarted server has lost the motion.
  function forget(id) {
    const samples = store.get().samples.filter(({ motion }) => motion.id !== id);
    store.set({ samples, chosen: samples[0]?.key ?? null });
  }

  function label() {
    const { samples, chosen, favourites, live } = store.get();
    const cells = stage.cells();
    keyed(find("views"), samples.length > 1 && !live ? samples : [], ({ key }) => key, () => make("div", { class: "view" }), (view, sample) => {
      const { x, y, width, height } = cells[samples.indexOf(sample)] ?? cells[0];
      view.style.cssText = `left:${x}px;top:${y}px;width:${width}px;height:${height}px`;
      view.classList.toggle("on", sample.key === chosen);
      const pinned = favourites.some(({ motion }) => motion.id === sample.motion.id);
      view.replaceChildren(
        button(nameOf(sample), () => studio.choose(sample.key), { class: "pill", "aria-pressed": String(sample.key === chosen) }),
        button("", () => pin(sample), { class: "pill", "aria-pressed": String(pinned), "aria-label": `Pin ${nameOf(sample)}` }, "pin"));
    });
  }

  const nameOf = ({ seed, steps }) => (steps === "recorded" ? "Recorded" : `Seed ${seed}`);
  const stageOf = ({ steps, motion }) => `${steps === "full" || steps === "recorded" ? "" : "preview, "}${motion.duration.toFixed(1)} s`;

  function pin(sample) {
    const { favourites } = store.get();
    if (favourites.some(({ motion }) => motion.id === sample.motion.id))
      return store.set({ favourites: favourites.filter(({ motion }) => motion.id !== sample.motion.id) });
    if (sample.key !== store.get().chosen) studio.choose(sample.key);
    afterPicture(() => store.set({ favourites: [...store.get().favourites, { ...sample, name: nameOf(sample), picture: stage.picture(144) }] }));
  }

  // What is made from now on begins with this motion.
  function useFavourite(favourite) {
    const sample = { ...favourite, key: `favourite ${favourite.motion.id}`, varied: true };
    store.set({ samples: [sample], chosen: sample.key });
    studio.remember(studio.present(), [sample], sample.key);
  }

  watch(store, ({ samples, chosen, characters, history, live }) => [samples, chosen, characters, history.present.figure.character, live !== null], (state) => {
    for (const each of state.characters) if (!known.has(lookOf(each))) broken.delete(each.id); // added again, or corrected
    known = new Set(state.characters.map(lookOf));
    if (!state.live) return show(state);
    asked++; // what is on its way does not come: a stream has the stage
    find("stage").setAttribute("aria-busy", "false");
    label();
  });
  watch(store, ({ history }) => [history.present.figure.materials], ({ history }) => wear(history.present.figure));
  watch(store, ({ favourites, samples, chosen }) => [favourites, samples, chosen], label);
  new ResizeObserver(label).observe(find("stage"));
  return { nameOf, stageOf, pin, useFavourite };
}
