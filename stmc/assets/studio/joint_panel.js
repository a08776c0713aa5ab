// Which joint of the character is which of ours: a list of choices. The server checks them and keeps them with the
// character. What it refuses stays in the list, unsaved, because some corrections fit only together, such as a swap.

import * as server from "./server.js";
import { find, make, say, watch } from "./dom.js";

const titleOf = (joint) => joint.charAt(0).toUpperCase() + joint.slice(1).replaceAll("_", " ");

// `refresh` reads the list of characters, which the stage follows.
export function createJointPanel(studio, refresh) {
  const { store } = studio;
  const panel = find("joint-map");
  let id = null; // of the character in the list
  let stored = null; // its joint map as the server describes it
  let wanted = {}; // corrections: those that are stored, and those that are refused so far
  let refusal = null; // a sentence
  let turn = Promise.resolve(); // changes are sent one after the other
  const choices = new Map(); // joint → its select

  async function read() {
    const asked = (id = studio.worn().id);
    [stored, wanted, refusal] = [null, {}, null];
    try {
      const answer = await server.jointMap(asked);
      if (asked !== id) return;
      [stored, wanted] = [answer, answer.corrections];
    } catch (error) {
      if (asked !== id) return;
      refusal = error.message;
    }
    list();
  }

  function list() {
    choices.clear();
    for (const joint of stored?.joints ?? []) {
      const names = stored.names.map((name) => make("option", { value: name }, name));
      choices.set(joint, make("select", { "data-key": `joint-${joint}`, onchange: ({ target }) => change({ ...wanted, [joint]: target.value || null }) },
        make("option", { value: "" }, "Not driven"), names));
    }
    find("joint-list").replaceChildren(...[...choices].map(([joint, select]) => make("label", { class: "field" }, make("span", {}, titleOf(joint)), select)));
    paint();
  }

  function paint() {
    for (const [joint, select] of choices)
      select.value = (refusal && joint in wanted ? wanted[joint] : stored.joint_map[joint]) ?? "";
    find("joint-refusal").hidden = !refusal;
    find("joint-refusal").textContent = refusal ?? "";
    find("joint-about").textContent = stored ? `Found by ${stored.found_by}.` : "";
    find("joint-reset").disabled = !refusal && !Object.keys(wanted).length;
  }

  function change(corrections) {
    const of = id;
    wanted = corrections;
    const current = () => of === id && wanted === corrections; // no later change, and no other character
    turn = turn.then(() => current() && send(of, corrections, current)).catch((error) => say(error.message));
  }

  async function send(of, corrections, current) {
    try {
      const answer = await server.correctJoints(of, corrections);
      if (current()) {
        const before = stored;
        [stored, wanted, refusal] = [answer, answer.corrections, null];
        if (before) paint();
        else list();
      }
      await refresh();
    } catch (error) {
      if (!current()) return;
      refusal = `Not saved: ${error.message}`;
      paint();
    }
  }

  find("joint-reset").onclick = () => change({});
  panel.addEventListener("toggle", () => panel.open && read());
  find("character-menu").addEventListener("beforetoggle", ({ newState }) => {
    if (newState === "open" && panel.open && !panel.hidden) read(); // another tab may have changed it
  });
  watch(store, ({ characters, history }) => [characters, history.present.figure.character], () => {
    const worn = studio.worn();
    panel.hidden = !worn || Boolean(worn.missing);
    if (panel.hidden) id = null;
    else if (panel.open && worn.id !== id) read();
  });
}
