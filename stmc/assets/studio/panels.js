// The panels beside the stage: the chosen prompt, samples and favourites, what the model knows. Draw the state and turn
// clicks into edits; `constraint_panel.js` has the constraints.

import { button, fill, find, make, watch } from "./dom.js";
import { colourOf } from "./colours.js";
import { lostParts, missingParts, named, reason } from "./claims.js";
import { MOST_SAMPLES, PARTS, duration, promptOf, rounded } from "./state.js";
import { written } from "./times.js";

const number = (key, label, value, commit, more = {}) =>
  make("label", { class: "field" }, make("span", {}, label),
    make("input", { type: "number", value: String(value), step: "0.1", min: "0", "data-key": key, onchange: ({ target }) => Number.isFinite(target.valueAsNumber) && commit(target.valueAsNumber), ...more }));

const toggle = (key, text, checked, change) =>
  make("label", { class: "check" }, make("input", { type: "checkbox", checked, "data-key": key, onchange: ({ target }) => change(target.checked) }), make("span", {}, text));

const heading = (text, ...more) => make("h2", {}, text, ...more);

const doubtMark = (label, title) => make("b", { class: "doubt", role: "img", "aria-label": label, title }, "?");

// ---- the prompt -----------------------------------------------------------------------------------------------------------
export function createPromptPanel(studio, player, work, tracks) {
  const { store } = studio;
  const panel = find("panel-prompt");
  const edit = (edit) => studio.edit(edit);

  function paint({ selected, history, check }) {
    const prompt = promptOf(history.present, selected);
    fill(panel, ...(prompt ? ofPrompt(prompt, check, history) : ofTimeline(history.present, check)));
  }

  function ofPrompt(prompt, check, history) {
    const { id, text, start, end, locked } = prompt;
    const told = check?.prompts[id];
    return [
      make("div", { class: "heading" }, make("i", { class: "swatch", style: `background:${colourOf(prompt.colour)}` }), heading("Prompt"),
        button("", () => store.set({ selected: null }), { class: "plain", "aria-label": "Choose no prompt", "data-key": "none" }, "close")),
      make("textarea", { rows: "2", value: text, "aria-label": "Text", "data-key": `text-${id}`, onkeydown: (event) => applied(event, id), onchange: ({ target }) => edit({ kind: "write", id, text: target.value }) }),
      check?.prompt === id ? make("p", { class: "advice" }, check.error) : null,
      told?.advice ? advice(id, told.advice) : null,
      told?.read_as ? make("p", { class: "faint" }, `The model reads “${told.read_as}”.`) : null,
      make("div", { class: "pair" },
        number(`start-${id}`, "Start (s)", start, (value) => edit({ kind: "place", id, start: value, end: Math.max(end, value + 0.1) })),
        number(`end-${id}`, "End (s)", end, (value) => edit({ kind: "place", id, start: Math.min(start, Math.max(0, value - 0.1)), end: value }))),
      chips(prompt, told),
      ...(told ? lacking(prompt, told, check, history.present) : []),
      make("div", { class: "actions" },
        button("Regenerate", () => work.regeneratePrompt(id), { "data-key": "regenerate", title: "Sample what this prompt decides again and keep the rest (M)" }, "dice"),
        button(locked ? "Unlock" : "Lock", () => edit({ kind: "lockPrompt", id }), { "aria-pressed": String(Boolean(locked)), "data-key": "lock", title: "Keep what this prompt decides as it is (L)" }, "lock"),
        button("Split", () => studio.make({ kind: "split", id, at: player.time() }), { "data-key": "split", title: "In two at the cursor (S)" }, "split"),
        button("Duplicate", () => studio.make({ kind: "duplicate", id }), { "data-key": "duplicate", title: "Once more behind it (D)" }, "copy"),
        button("Delete", () => edit({ kind: "remove", id }), { "data-key": "delete", title: "Delete the prompt" }, "trash")),
    ];
  }

  // Enter applies what is typed, as on the track; leaving the field does so, too.
  function applied(event, id) {
    if (event.key !== "Enter" || event.ctrlKey || event.metaKey || event.isComposing) return;
    event.preventDefault();
    event.target.blur();
    queueMicrotask(() => tracks.focus(id));
  }

  const advice = (id, { sentence, known, nearest }) => known ? make("p", { class: "advice" }, sentence) : make("div", { class: "advice" },
    make("p", {}, `The model hardly knows this and may do something else. ${nearest.length ? "It knows:" : "It knows nothing near."}`),
    make("div", { class: "chips" }, nearest.length
      ? nearest.map((text) => button(text, () => edit({ kind: "write", id, text }), { class: "chip", "data-key": `near-${text}` }))
      : button("See what it knows", () => find("tab-words").click(), { class: "chip", "data-key": "words" })));

  function chips({ id, parts }, told) {
    const claimed = parts.length ? parts : told?.parts ?? [];
    const suggested = !parts.length && told;
    const sure = suggested && told.confidence !== null ? `, ${Math.round(100 * told.confidence)} % sure` : "";
    return make("fieldset", {}, make("legend", {}, "Body parts ", suggested ? make("span", { class: "faint" }, `suggested${sure}`) : null,
      parts.length ? button("Suggest", () => edit({ kind: "claim", id, parts: [] }), { class: "link", "data-key": "suggest" }) : null),
    make("div", { class: "chips" }, PARTS.map((part) => {
      const on = claimed.includes(part);
      const next = on ? claimed.filter((other) => other !== part) : [...claimed, part];
      return button(part, () => edit({ kind: "claim", id, parts: next }), {
        class: `chip${on ? " on" : ""}${suggested ? " suggested" : ""}`, "aria-pressed": String(on), "data-key": `part-${part}`,
      });
    })));
  }

  // Body parts that the action needs: those that it should claim, and those that another prompt has.
  function lacking({ id, ...prompt }, told, check, document) {
    const claim = (label, parts) => button(label, () => edit({ kind: "claim", id, parts }), { class: "chip", "data-key": label });
    const missing = missingParts(told);
    const offer = missing.length ? [make("div", { class: "advice" },
      make("p", {}, `This usually moves ${named(missing)}, which the prompt does not claim.`),
      make("div", { class: "chips" }, claim(`Claim ${named(missing)}, too`, PARTS.filter((part) => [...told.parts, ...missing].includes(part)))))] : [];
    return [...offer, ...lostParts({ id, ...prompt }, told, check.owners).map((lost) => {
      const needed = told.needs.filter((part) => lost.parts.includes(part));
      return make("div", { class: "advice" },
        make("p", {}, `“${promptOf(document, lost.id)?.text}” has ${named(lost.parts)} from ${written(lost.start)} to ${written(lost.end)}${reason(told.parts.length, check.prompts[lost.id]?.parts.length)}.`),
        needed.length && needed.length < told.parts.length ? make("div", { class: "chips" }, claim(`Claim only ${named(needed)}`, needed)) : null);
    })];
  }

  function ofTimeline(document, check) {
    const start = document.prompts.length ? [] : [
      make("p", {}, "Double-click a track, or press N, and write what the person does. Several prompts may hold at once, each for its own body parts."),
      make("div", { class: "actions" }, button("Write a prompt", () => tracks.draft(0, 0), { class: "primary", "data-key": "first" }, "plus"),
        button("Open an example", () => find("open").click(), { "data-key": "examples" }, "folder")),
    ];
    return [
      heading("Timeline"),
      ...start,
      ...(check?.error && !check.prompt ? [make("p", { class: "advice" }, check.error)] : []),
      ...(check?.warnings ?? []).flatMap((warning) => warning.split("\n")).map((sentence) => make("p", { class: "advice" }, sentence)),
      make("ol", { class: "list" }, document.prompts.map((prompt) => entry(prompt, check))),
    ];
  }

  function entry(prompt, check) {
    const choose = () => {
      store.set({ selected: prompt.id });
      queueMicrotask(() => tracks.focus(prompt.id));
    };
    const doubt = check?.prompts[prompt.id]?.advice;
    return make("li", {}, make("button", { type: "button", class: "entry", onclick: choose, "data-key": prompt.id },
      make("i", { class: "swatch", style: `background:${colourOf(prompt.colour)}` }), make("span", {}, prompt.text),
      doubt ? doubtMark(doubt.known ? "it rarely works" : "the model hardly knows it", doubt.sentence) : null,
      make("span", { class: "faint" }, `${written(prompt.start)} to ${written(prompt.end)}`)));
  }

  watch(store, ({ selected, history, check }) => [selected, history.present.prompts, check], paint);
}

// ---- samples --------------------------------------------------------------------------------------------------------------
export function createSamplesPanel(studio, work, page) {
  const { store } = studio;
  const panel = find("panel-samples");
  const set = (name, value) => studio.edit({ kind: "set", name, value }); // a setting of the request
  const randomSeeds = (count) => Array.from({ length: count }, () => Math.floor(Math.random() * 100000));

  function count(wanted) {
    const { seeds } = studio.present();
    const fresh = seeds.length < wanted ? [...seeds, ...seeds.concat(randomSeeds(wanted)).slice(seeds.length, wanted)] : seeds.slice(0, wanted);
    studio.edit({ kind: "seeds", seeds: fresh });
    if (!store.get().auto) work.generate();
  }

  function paint({ history, samples, chosen, favourites, quality, auto }) {
    const document = history.present;
    fill(panel,
      heading("Samples"),
      make("div", { class: "spread" },
        make("div", { class: "segments", role: "group", "aria-label": "How many samples" },
          Array.from({ length: MOST_SAMPLES }, (_, index) => button(String(index + 1), () => count(index + 1), {
            "aria-pressed": String(document.seeds.length === index + 1), "data-key": `count-${index}`, "aria-label": `${index + 1} at a time`,
          }))),
        button("New seeds", () => {
          studio.edit({ kind: "seeds", seeds: randomSeeds(document.seeds.length) });
          if (!store.get().auto) work.generate();
        }, { "data-key": "dice", title: "Other samples of the same timeline" }, "dice")),
      make("ul", { class: "list" }, samples.map((sample) => ofSample(sample, sample.key === chosen, favourites))),
      ...(samples.find(({ key }) => key === chosen)?.missed ?? []).map(({ sentence }) => make("p", { class: "advice" }, sentence)),
      samples.length ? null : make("p", { class: "faint" }, "None yet."),
      heading("Favourites"),
      favourites.length ? make("ul", { class: "favourites" }, favourites.map(ofFavourite))
        : make("p", { class: "faint" }, "Pin a sample to keep it, whatever you change."),
      heading("Kept"),
      toggle("gaps", "Keep what no prompt claims", document.locks.gaps, (on) => studio.edit({ kind: "lockGaps", on })),
      make("p", { class: "faint" }, locksOf(document)),
      heading("How it is made"),
      toggle("auto", "Preview after each edit", auto, (on) => store.set({ auto: on })),
      toggle("full", "Full quality behind the preview", quality === "full", (on) => store.set({ quality: on ? "full" : "preview" })),
      toggle("feet", "Clean feet: they stand where they stand", document.settings.clean_feet, (on) => set("clean_feet", on)));
  }

  function locksOf({ prompts, locks }) {
    const held = [
      ...prompts.filter(({ locked }) => locked).map(({ text }) => `“${text}”`), ...locks.parts,
      ...locks.spans.map(({ start, end }) => `${written(start)} to ${written(end)}`),
    ];
    return held.length ? `Locked: ${held.join(", ")}.` : "Lock prompts, body parts (their names beneath the tracks) or an interval, and only the rest is regenerated.";
  }

  function ofSample(sample, on, favourites) {
    const pinned = favourites.some(({ motion }) => motion.id === sample.motion.id);
    return make("li", { class: `sample${on ? " on" : ""}` },
      button(page.nameOf(sample), () => studio.choose(sample.key), { class: "entry", "aria-pressed": String(on), "data-key": `sample-${sample.key}` }),
      sample.missed?.length ? doubtMark("it does not show every prompt", sample.missed.map(({ sentence }) => sentence).join("\n")) : null,
      make("span", { class: "faint" }, page.stageOf(sample)),
      button("", () => page.pin(sample), { class: "plain", "aria-pressed": String(pinned), "aria-label": `${pinned ? "Unpin" : "Pin"} ${page.nameOf(sample)}`, "data-key": `pin-${sample.key}` }, "pin"));
  }

  const ofFavourite = (favourite) => make("li", {},
    make("button", { type: "button", onclick: () => page.useFavourite(favourite), "data-key": `use-${favourite.motion.id}`, title: "Continue with this one" },
      favourite.picture?.startsWith("data:image/") ? make("img", { src: favourite.picture, alt: "", width: "72", height: "72" }) : null, make("span", {}, favourite.name)),
    button("", () => store.set({ favourites: store.get().favourites.filter((other) => other !== favourite) }), { class: "plain", "aria-label": `Remove ${favourite.name}` }, "close"));

  watch(store, ({ history: { present: { prompts, locks, seeds, settings } }, samples, chosen, favourites, quality, auto }) =>
    [prompts, locks, seeds, settings, samples, chosen, favourites, quality, auto], paint);
}

// ---- what the model knows ---------------------------------------------------------------------------------------------------
// `next(text, parts)`: what a stream plays next.
export function createWordsPanel(studio, player, next) {
  const { store } = studio;
  const panel = find("panel-words");
  const list = make("div", {});
  const field = make("input", { type: "search", placeholder: "Search what the model knows", "aria-label": "Search what the model knows", oninput: () => paint(store.get()) });
  panel.append(heading("What the model knows"), field, list);

  function paint({ model }) {
    const actions = model?.contents ?? [], wanted = field.value.trim().toLowerCase();
    const matches = actions.filter(({ title, examples }) => !wanted || [title, ...examples].some((text) => text.toLowerCase().includes(wanted)));
    const topics = Map.groupBy(matches, ({ topic }) => topic);
    find("known-texts").replaceChildren(...actions.map(({ examples }) => make("option", { value: examples[0] })));
    list.replaceChildren(
      ...[...topics].flatMap(([topic, members]) => [make("h3", {}, topic), make("ul", { class: "list" }, members.map(entry))]),
      matches.length ? "" : make("p", { class: "faint" }, actions.length ? "Nothing of that name." : "The model does not say what it knows."));
  }

  function entry({ title, parts, examples }) {
    return make("li", {},
      make("button", { type: "button", class: "entry", onclick: () => write(examples[0], parts), title: examples.join("\n") },
        make("span", {}, title), make("span", { class: "faint" }, parts.length === PARTS.length ? "whole body" : parts.join(", "))));
  }

  // Into the chosen prompt, or else as a new one at the cursor.
  function write(text, parts) {
    if (store.get().live) return next(text, parts);
    const prompt = promptOf(studio.present(), store.get().selected);
    if (prompt) return studio.edit({ kind: "write", id: prompt.id, text });
    const start = Math.min(rounded(player.time()), duration(studio.present()));
    studio.make({ kind: "add", text, start, end: start + 3, parts, track: 0 });
  }

  watch(store, ({ model }) => [model], paint);
}

export { heading, number };
