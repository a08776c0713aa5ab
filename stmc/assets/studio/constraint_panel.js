// The constraints' panel: what is demanded beside the texts, each with its error once a sample has met it or not.

import { button, fill, find, make, watch } from "./dom.js";
import { heading, number } from "./panels.js";
import { rounded } from "./state.js";
import { degrees, demandOf, errorOf, fieldOf, kindOf, lengthOf, meets, paceOf, said, spanOf, titleOf } from "./constraints.js";

const SHORTEST = 0.1; // metres of a drawn line
const TIMES = ["start", "end", "moment", "motion_second"];

const GRIPS = ["left_hand", "right_hand", "left_foot", "right_foot", "head"];

// The kind of constraint that puts a joint at a place.
const targetKind = ({ constraints }) => constraints.find(({ name }) => fieldOf(name, "joint") && fieldOf(name, "point"));

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

  // The values of a new constraint, by the controls of its fields.
  function fresh({ name, fields }) {
    const [{ start, end }, motion] = [span(fieldOf(name, "end")?.default), studio.chosen()?.motion];
    const usual = (field) => field.default;
    const begin = {
      start: () => start, end: () => end, moment: now, joint: usual, angle: usual, number: usual,
      point: (field) => stage.joint(fieldOf(name, "joint")?.default) ?? field.default,
      motion: () => motion.id,
      motion_second: () => Math.max(0, Math.min(now(), rounded(motion.duration - 0.05))),
    };
    return { kind: name, ...Object.fromEntries(fields.map((field) => [field.name, begin[field.control](field)])) };
  }

  function added(kind) {
    if (fieldOf(kind.name, "line")) return store.set({ drawing: kind.name });
    if (!fieldOf(kind.name, "motion") || studio.chosen()) add(fresh(kind));
  }

  function drawn(points) {
    const { drawing: kind, span: chosen } = store.get();
    store.set({ drawing: false });
    const line = simplified(points).map((point) => point.map((value) => Math.round(value * 100) / 100));
    if (!kind || line.length < 2 || lengthOf(line) < SHORTEST) return;
    add({ kind, [fieldOf(kind, "line").name]: line, start: chosen?.start ?? 0, end: chosen?.end ?? null });
  }

  // A joint of the pose at the cursor is pulled: a target of that moment follows the hand, one for each joint.
  let pull = null; // {gesture, edit}
  function pulled(joint, place, finished) {
    pull ??= { gesture: studio.gesture(), edit: pulling(joint) };
    studio.edit(pull.edit(place.map(rounded)), pull.gesture);
    if (!finished) return;
    const { id } = pull.edit;
    pull = null;
    studio.settle();
    store.set({ constraint: id });
  }

  // The edit by which a target of this joint is at a place: the one that holds now, or a new one.
  function pulling(joint) {
    const { name } = targetKind(store.get().model);
    const [point, whose, moment] = [fieldOf(name, "point").name, fieldOf(name, "joint").name, now()];
    const holds = (each) => spanOf(each, Infinity).start <= moment && moment <= spanOf(each, Infinity).end;
    const old = studio.present().constraints.find((each) => each.kind === name && each[whose] === joint && holds(each));
    const blank = { ...fresh(kindOf(name)), [whose]: joint, [fieldOf(name, "start").name]: moment, [fieldOf(name, "end").name]: null };
    const edit = (place) => old ? { kind: "adjust", id: old.id, change: { [point]: place } } : { kind: "constrain", constraint: { ...blank, [point]: place } };
    return Object.assign(edit, { id: old?.id ?? `c${studio.present().next}` });
  }

  // What a hand takes the pose by, while there is one to pull: asked for, or beside a place or a pose that is chosen.
  function gripsOf({ model, pulling, constraint, samples, history }) {
    const kind = history.present.constraints.find(({ id }) => id === constraint)?.kind;
    const posed = kind && (fieldOf(kind, "point") || fieldOf(kind, "motion"));
    const target = model && targetKind(model);
    if (!target || !samples.length || !(pulling || posed)) return [];
    const { choices } = fieldOf(target.name, "joint");
    return GRIPS.filter((joint) => choices.includes(joint));
  }

  function paint({ model, history, samples, chosen, constraint, drawing }) {
    const sample = samples.find(({ key }) => key === chosen);
    const { constraints } = history.present;
    const missed = constraints.length > 1 && constraints.some((each) => demandOf(sample, each) && !meets(each, demandOf(sample, each)));
    fill(panel,
      heading("Constraints"),
      make("p", { class: "faint" }, "Demands beside the texts. They hold for the chosen interval, or from the cursor on."),
      make("div", { class: "chips", role: "group", "aria-label": "Add a constraint" }, (model?.constraints ?? []).map((kind) => button(kind.title, () => added(kind), {
        class: "chip", title: kind.about, "data-key": `add-${kind.name}`, disabled: Boolean(fieldOf(kind.name, "motion")) && !samples.length,
      }, kind.name))),
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
    const { fields, open_end } = kindOf(each.kind);
    const timed = fields.filter(({ control }) => TIMES.includes(control));
    const time = ({ name, control, title, least, most }) => number(`${name}-${each.id}`, title, each[name] ?? "", (value) => adjust(each.id, { [name]: rounded(value) }),
      { min: least, max: most, ...(control === "end" ? { placeholder: `the ${open_end}` } : {}) });
    return [make("div", { class: "pair" }, timed.map(time)), ...fields.flatMap((field) => EDITORS[field.control]?.(each, field) ?? [])];
  }

  const EDITORS = {
    joint: ({ id, ...values }, { name, title, choices }) => make("label", { class: "field" }, make("span", {}, title),
      make("select", { "data-key": `${name}-${id}`, onchange: ({ target }) => adjust(id, { [name]: target.value }) },
        choices.map((joint) => make("option", { value: joint, selected: joint === values[name] }, said(joint))))),
    point: ({ id, ...values }, { name, least, most }) => make("div", { class: "triple" }, ["x", "y", "z"].map((axis, index) =>
      number(`${axis}-${id}`, `${axis} (m)`, Math.round(values[name][index] * 100) / 100, (value) => adjust(id, { [name]: values[name].map((old, at) => (at === index ? value : old)) }), { step: "0.05", min: least, max: most }))),
    number: ({ id, ...values }, { name, title, least, most }) => number(`${name}-${id}`, title, values[name], (value) => adjust(id, { [name]: value }), { step: "any", min: least, max: most }),
    angle: ({ id, ...values }, { name, title }) => number(`${name}-${id}`, title, degrees(values[name]), (value) => adjust(id, { [name]: (value * Math.PI) / 180 }), { step: "15", min: null }),
    line: (each, { name, title }) => [make("p", { class: "faint" }, paceOf({ points: each[name], ...spanOf(each, studio.duration()) }, studio.duration())), make("label", { class: "field" }, make("span", {}, title),
      make("textarea", { rows: "2", "data-key": `${name}-${each.id}`, value: each[name].map((point) => point.join(", ")).join("; "), onchange: ({ target }) => typed(each.id, name, target.value) }))],
  };

  function typed(id, name, text) {
    const points = text.split(";").map((pair) => pair.split(",").map(Number));
    if (points.length > 1 && points.every((point) => point.length === 2 && point.every(Number.isFinite))) adjust(id, { [name]: points });
  }

  watch(store, ({ model, history: { present: { constraints } }, samples, chosen, constraint, drawing }) =>
    [model, constraints, samples, chosen, constraint, drawing], paint);
  return { drawn, pulled, gripsOf };
}
