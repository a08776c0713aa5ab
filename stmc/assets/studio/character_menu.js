// Who moves: the mannequin or a character of the user's own. Adds files, switches, deletes; `joint_panel.js` corrects its
// joints, `preview.js` shows it.

import * as server from "./server.js";
import { button, fill, find, make, say, watch } from "./dom.js";
import { createJointPanel } from "./joint_panel.js";

const MIB = 2 ** 20;

export function createCharacterMenu(studio) {
  const { store } = studio;
  const [menu, opener, materials] = ["character-menu", "character", "materials"].map(find);
  const wear = (change) => studio.edit({ kind: "wear", change });

  async function refresh() {
    store.set({ characters: await server.listCharacters() });
  }

  // Also a robot: what is said of it, the server knows.
  const isOne = (file) => [...(store.get().model?.characters.receives ?? []), ".urdf", ".xml"].some((suffix) => file.name.toLowerCase().endsWith(suffix));

  // Of a file that was dropped or chosen; it moves from now on.
  async function add(file) {
    const { most } = store.get().model.characters;
    if (file.size > most) throw new Error(`${file.name} has ${Math.ceil(file.size / MIB)} MiB; a character has ${most / MIB} at most.`);
    opener.classList.add("busy");
    try {
      const { id, name } = await server.addCharacter(file);
      await refresh();
      wear({ character: { id, name } });
      if (!store.get().samples.length) say(`${name} moves as soon as there is a motion.`);
    } finally {
      opener.classList.remove("busy");
    }
  }

  async function remove({ id }) {
    await server.deleteCharacter(id);
    if (studio.worn()?.id === id) wear({ character: null });
    await refresh();
  }

  const told = (act) => (...values) => act(...values).catch((error) => say(error.message));

  function entry(name, on, character) {
    const choose = () => {
      wear({ character });
      menu.hidePopover();
    };
    return make("li", {}, button(name, choose, { class: "entry", "aria-pressed": String(on), "data-key": `wear-${character?.id ?? "mannequin"}` }));
  }

  function paint({ characters, model }) {
    const worn = studio.worn();
    opener.querySelector("span").textContent = worn && !worn.missing ? worn.name : "Mannequin";
    const own = studio.present().figure.materials === "own";
    materials.hidden = !worn || Boolean(worn.missing);
    materials.setAttribute("aria-pressed", String(own));
    fill(find("character-list"), entry("Mannequin", !worn || worn.missing, null), ...characters.map(({ id, name }) => {
      const item = entry(name, worn?.id === id, { id, name });
      item.append(button("", told(() => remove({ id })), { class: "plain", "aria-label": `Delete ${name}`, "data-key": `delete-${id}` }, "trash"));
      return item;
    }));
    find("character-file").accept = (model?.characters.receives ?? []).join();
  }

  menu.addEventListener("beforetoggle", () => {
    const { left, top } = opener.getBoundingClientRect();
    Object.assign(menu.style, { left: `${left}px`, bottom: `${innerHeight - top + 8}px` });
  });
  menu.addEventListener("toggle", ({ newState }) => opener.setAttribute("aria-expanded", String(newState === "open")));
  find("character-file").onchange = ({ target }) => {
    const [file] = target.files;
    target.value = "";
    menu.hidePopover();
    if (file) told(add)(file);
  };
  materials.onclick = () => wear({ materials: studio.present().figure.materials === "own" ? "prompts" : "own" });
  watch(store, ({ characters, model, history }) => [characters, model, history.present.figure], paint);
  createJointPanel(studio, refresh);
  return { add, isOne, refresh };
}

// Files that are dropped anywhere on the page go to `take`.
export function listenToDrops(take) {
  const hint = find("dropping");
  let depth = 0; // of the elements that the pointer is over
  const over = (by) => {
    depth = Math.max(0, depth + by);
    hint.hidden = depth === 0;
  };
  const brings = ({ dataTransfer }) => [...(dataTransfer?.types ?? [])].includes("Files");
  addEventListener("dragenter", (event) => brings(event) && over(1));
  addEventListener("dragleave", (event) => brings(event) && over(-1));
  addEventListener("dragover", (event) => brings(event) && event.preventDefault());
  addEventListener("drop", (event) => {
    if (!brings(event)) return;
    event.preventDefault();
    over(-depth);
    const [file] = event.dataTransfer.files;
    if (file) take(file).catch((error) => say(error.message));
  });
}
