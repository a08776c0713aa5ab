// The constraints' panel: what is demanded beside the texts, each with its error once a sample has met it or not.

import { button, fill, find, make, watch } from "./dom.js";
import { heading, number } from "./panels.js";
import { rounded } from "./state.js";
import { NAMES, degrees, demandOf, errorOf, meets, paceOf, said, titleOf } from "./constraints.js";

const LIMBS = ["left_hand", "right_hand", "left_foot", "right_foot", "left_wrist", "right_wrist", "left_ankle", "right_ankle", "head", "pelvis"];
const ABOUT = {
  path: "The person walks along a line on the floor: draw it.",
  target: "A hand or foot is at a place: drag the ball.",
  hold: "A hand or foot stays where it is.",
  keyframe: "The pose at the cursor is had again at that time.",
  heading: "The body looks in a direction.",
};

// Fewer points of a drawn line: none nearer to its neighbours than the way deserves (Douglas and Peucker, 1973).
export function simplified(points, slack = 0.06) {
  if (points.length < 3) return points;
  const [[ax, ay], [bx, by]] = [points[0], points.at(-1)];
  const length = Math.hypot(bx - ax, by - ay);
  let [farthest, index] = [0, 0];
  points.forEach(([x, y], at) => {
    const away = length < 1e-6 ? Math.hypot(x - ax, y - ay) : Math.abs((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / length;
    if (away > farthest) [farthest, index] = [away, at];
  });
  if (farthest <= slack) return [points[0], points.at(-1)];
  return [...simplified(points.slice(0, index + 1), slack).slice(0, -1), ...simplified(points.slice(index), slack)];
}

export function createConstraintPanel(studio, player, stage) {
  const { store } = studio;
  const panel = find("panel-constraints");
  const adjust = (id, change) => studio.edit({ kind: "adjust", id, change });

  const now = () => Math.round(player.time() * 20) / 20;

  // The chosen interval, or a second from the cursor on.
  function span(length = 1) {
    const { span: chosen } = store.get();
    if (chosen) return chosen;
    const start = Math.min(now(), Math.max(0, rounded(studio.duration() - length)));
    return { start, end: rounded(start + length) };
  }

  function add(constraint) {
    const id = `c${studio.present().next}`;
    studio.edit({ kind: "constrain", constraint });
    store.set({ constraint: id });
  }

  const ADD = {
    path: () => store.set({ drawing: true }),
    target: () => add({ kind: "target", joint: "right_hand", point: stage.joint("right_hand") ?? [-0.3, -0.4, 1.2], ...span() }),
    hold: () => add({ kind: "hold", joint: "right_hand", ...span(2) }),
    keyframe() {
      const base = studio.chosen();
      if (base) add({ kind: "keyframe", motion: base.motion.id, second: Math.max(0, Math.min(now(), rounded(base.motion.duration - 0.05))), at: now() });
    },
    heading: () => add({ kind: "heading", angle: 0, ...span(2) }),
  };

  function drawn(points) {
    store.set({ drawing: false });
    const path = simplified(points).map((point) => point.map((value) => Math.round(value * 100) / 100));
    if (path.length < 2) return;
    const { span: chosen } = store.get();
    add({ kind: "path", points: path, start: chosen?.start ?? 0, end: chosen?.end ?? null });
  }

  function paint({ model, history, samples, chosen, constraint, drawing }) {
    const sample = samples.find(({ key }) => key === chosen);
    const { constraints } = history.present;
    const missed = constraints.length > 1 && constraints.some((each) => demandOf(sample, each) && !meets(each, demandOf(sample, each)));
    const kinds = (model?.constraints ?? Object.keys(NAMES)).filter((kind) => ADD[kind]);
    fill(panel,
      heading("Constraints"),
      make("p", { class: "faint" }, "Demands beside the texts. They hold for the chosen interval, or from the cursor on."),
      make("div", { class: "chips", role: "group", "aria-label": "Add a constraint" }, kinds.map((kind) => button(NAMES[kind], ADD[kind], {
        class: "chip", title: ABOUT[kind], "data-key": `add-${kind}`, disabled: kind === "keyframe" && !samples.length,
      }, kind))),
      drawing ? make("div", { class: "advice" }, make("p", {}, "Draw on the floor of the stage. Escape ends it."),
        make("div", { class: "actions" }, button("Type its points", () => drawn([[0, 0], [0, -3]]), { "data-key": "type-path" }))) : null,
      missed ? make("p", { class: "advice" }, "Constraints pull against each other: those in red are missed. Move one, give it more time, or delete one.") : null,
      make("ul", { class: "list constraints" }, constraints.map((each) => of(each, demandOf(sample, each), constraint))));
  }

  function of(each, demand, chosen) {
    const { id, kind } = each;
    return make("li", { class: chosen === id ? "on" : "" },
      make("div", { class: "heading" },
        button(titleOf(each), () => store.set({ constraint: chosen === id ? null : id }), { class: "entry", "aria-expanded": String(chosen === id), "data-key": `of-${id}` }, kind),
        demand ? make("span", { class: `error ${meets(each, demand) ? "fine" : "off"}`, title: "How far the motion is from it, at most" }, errorOf(demand)) : null,
        button("", () => studio.edit({ kind: "release", id }), { class: "plain", "aria-label": `Delete: ${titleOf(each)}` }, "close")),
      chosen === id ? make("div", { class: "details" }, fieldsOf(each)) : null);
  }

  function fieldsOf(each) {
    const { id, kind } = each;
    const time = (name, label) => number(`${name}-${id}`, label, each[name] ?? "", (value) => adjust(id, { [name]: rounded(value) }), name === "end" ? { placeholder: "the end" } : {});
    const times = kind === "keyframe" ? [time("at", "At (s)"), time("second", "Its second")] : [time("start", "Start (s)"), time("end", "End (s)")];
    return [make("div", { class: "pair" }, times), ...(FIELDS[kind]?.(each) ?? [])];
  }

  const joints = ({ id, joint }) => make("label", { class: "field" }, make("span", {}, "Joint"),
    make("select", { "data-key": `joint-${id}`, onchange: ({ target }) => adjust(id, { joint: target.value }) },
      LIMBS.map((name) => make("option", { value: name, selected: name === joint }, said(name)))));

  const FIELDS = {
    target: (each) => [joints(each), make("div", { class: "triple" }, ["x", "y", "z"].map((axis, index) =>
      number(`${axis}-${each.id}`, `${axis} (m)`, Math.round(each.point[index] * 100) / 100, (value) => adjust(each.id, { point: each.point.map((old, at) => (at === index ? value : old)) }), { step: "0.05", min: null })))],
    hold: (each) => [joints(each)],
    heading: (each) => [number(`angle-${each.id}`, "Degrees to the left of the start", degrees(each.angle), (value) => adjust(each.id, { angle: (value * Math.PI) / 180 }), { step: "15", min: null })],
    path: (each) => [make("p", { class: "faint" }, paceOf(each, studio.duration())), make("label", { class: "field" }, make("span", {}, "Points: x, y; x, y; … (m)"),
      make("textarea", { rows: "2", "data-key": `points-${each.id}`, value: each.points.map((point) => point.join(", ")).join("; "), onchange: ({ target }) => typed(each.id, target.value) }))],
  };

  function typed(id, text) {
    const points = text.split(";").map((pair) => pair.split(",").map(Number));
    if (points.length > 1 && points.every((point) => point.length === 2 && point.every(Number.isFinite))) adjust(id, { points });
  }

  watch(store, ({ model, history: { present: { constraints } }, samples, chosen, constraint, drawing }) =>
    [model, constraints, samples, chosen, constraint, drawing], paint);
  return { drawn };
}
