// From a document to motions: asks the server what a timeline means, and for its samples; previews first. Knows the
// server's jobs and what is kept of a motion; knows no elements.

import * as server from "./server.js";
import { asked, decidedBy, hasLocks, touched, unlocked, unlockedOf } from "./locks.js";
import { PARTS, duration, timelineOf } from "./state.js";

const CHECK_AFTER = 120; // milliseconds without an edit
const GENERATE_AFTER = 350;
const QUICKLY_AFTER = 20; // where a motion takes hardly longer than its edit
const AGAIN_AFTER = 2000; // where the server is away

export function createActions(studio, tab, say) {
  const { store } = studio;
  let stop = null; // of the job that runs
  let running = null;
  let next = null; // what waits for the job that runs
  let checking = null; // {document, stop, answered: a promise}, the request on its way
  let timers = {};

  const later = (name, delay, act) => {
    clearTimeout(timers[name]);
    timers[name] = setTimeout(act, delay);
  };

  // ---- what the timeline means ------------------------------------------------------------------------------------------
  function check() {
    const document = studio.present();
    checking?.stop.abort();
    const stop = new AbortController();
    const answered = ask(document, stop.signal).finally(() => {
      if (checking?.stop === stop) checking = null;
    });
    checking = { document, stop, answered };
    return answered;
  }

  async function ask(document, signal) {
    if (!document.prompts.length) return store.set({ check: null });
    try {
      const answer = await server.check(timelineOf(document), signal);
      if (!signal.aborted) store.set({ check: byId(document, answer) });
    } catch (error) {
      if (signal.aborted) return;
      if (error.status === 422) {
        const prompt = document.prompts[error.data.prompt]?.id ?? null;
        store.set({ check: { document, prompts: {}, owners: {}, transitions: {}, warnings: [], error: error.message, prompt } });
      } else later("check", AGAIN_AFTER, check);
    }
  }

  function byId(document, answer) {
    const id = (index) => (index === null ? null : document.prompts[index]?.id ?? null);
    const owners = Object.fromEntries(PARTS.map((part) => [
      part, (answer.owners[part] ?? []).map(([owner, start, end]) => [id(owner), start, end]),
    ]));
    const prompts = Object.fromEntries(answer.prompts.map((told, index) => [id(index), told]));
    return { document, prompts, owners, transitions: answer.transitions, warnings: answer.warnings, error: null, prompt: null };
  }

  // The answer for the document as it is now.
  async function checked() {
    if (checking?.document === studio.present()) await checking.answered;
    else if (store.get().check?.document !== studio.present()) {
      clearTimeout(timers.check);
      await check();
    }
    const { check: answer } = store.get();
    return answer && !answer.error && answer.document === studio.present() ? answer : null;
  }

  // ---- what is regenerated ------------------------------------------------------------------------------------------------
  const length = () => duration(studio.present());

  // After an edit: only what it has touched where the motion is not what the seed alone gives; else all.
  function afterEdit(plan) {
    const base = studio.chosen();
    if (!base?.varied) return everything(plan);
    const document = studio.present();
    return { base, change: unlockedOf(touched(base.asked, asked(document, plan)), document, plan, length()) };
  }

  function everything(plan) {
    const base = studio.chosen();
    if (!base || !hasLocks(studio.present())) return { base: null, change: [] };
    return { base, change: unlocked(studio.present(), plan, length()) };
  }

  // `wanted(plan)`, with other seeds.
  function changesOf(wanted, plan) {
    const base = studio.chosen();
    if (!base) return everything(plan);
    return { base, change: unlockedOf(wanted(plan), studio.present(), plan, length()), fresh: true };
  }

  // ---- jobs ---------------------------------------------------------------------------------------------------------------
  async function generate(scope = everything) {
    clearTimeout(timers.generate);
    if (store.get().live) return;
    const answer = await checked();
    if (!answer) return unanswered(scope);
    const { base, change, fresh } = scope(answer);
    if (base && !change.length) return scope === afterEdit ? null : say("Nothing is left to make: all of it is locked.");
    await cancel();
    const document = studio.present();
    const seeds = fresh ? document.seeds.map(() => Math.floor(Math.random() * 1e6)) : document.seeds;
    const about = { document, scope, seeds, asked: asked(document, answer), varied: Boolean(base), arrived: new Set() };
    store.set({ job: { stage: "waiting", seed: seeds[0], step: 0, steps: 0 } });
    try {
      const { job } = await server.startJob({
        ...document.settings, timeline: timelineOf(document), seeds, steps: store.get().quality, keep: base?.motion.id ?? null, change,
        constraints: document.constraints.map(argued), tab,
      });
      running = job;
      stop = server.followJob(job, (kind, data) => running === job && heard(kind, data, about));
    } catch (error) {
      store.set({ job: null });
      if (error.status === 0) later("generate", AGAIN_AFTER, () => generate(scope));
      else say(error.message, "Try again", () => generate(scope));
    }
  }

  function unanswered(scope) {
    const { check: answer } = store.get();
    if (answer?.error) say(answer.error);
    else if (!studio.present().prompts.length) say("Write a prompt first.");
    else later("generate", AGAIN_AFTER, () => generate(scope)); // the server is away, or another edit came between
  }

  function heard(kind, data, about) {
    if (kind === "progress") return store.set({ job: data });
    if (kind === "motion") return arrived(data, about);
    finish();
    if (kind === "failed") say(server.sentence(data.error), "Try again", () => generate(about.scope));
    if (kind === "lost") later("generate", AGAIN_AFTER, () => generate(about.scope)); // the server restarted
    if (kind === "done" && next) [next, timers.next] = [null, setTimeout(next)];
  }

  function arrived({ seed, stage, motion, demands, missed }, about) {
    about.arrived.add(seed);
    const met = demands.map((demand, index) => ({ ...demand, of: about.document.constraints[index] }));
    const sample = { key: String(seed), seed, steps: stage, motion, demands: met, missed, asked: about.asked, varied: about.varied };
    const old = store.get().samples.filter((other) => other.seed !== seed);
    const kept = old.filter((other) => about.seeds.includes(other.seed) && about.arrived.has(other.seed));
    const samples = [...kept, sample].sort((one, other) => about.seeds.indexOf(one.seed) - about.seeds.indexOf(other.seed));
    const { chosen } = store.get();
    const next = samples.some(({ key }) => key === chosen) ? chosen : samples[0].key;
    store.set({ samples, chosen: next });
    studio.remember(about.document, samples, next);
  }

  function finish() {
    stop?.();
    [stop, running] = [null, null];
    store.set({ job: null });
  }

  async function cancel() {
    const job = running;
    next = null;
    finish();
    if (job !== null) await server.cancelJob(job).catch(() => {}); // it may have ended meanwhile
  }

  // What is kept of a motion should be its full quality: waits for it where it is on its way.
  function regenerate(wanted) {
    const act = () => generate((plan) => changesOf(wanted, plan));
    if (running !== null && studio.chosen()?.steps === "preview") next = act;
    else act();
  }

  let seen = null;
  let scope = afterEdit;
  let open = null;
  store.subscribe(({ id, history, quality, live }) => {
    const document = history.present;
    if (open !== id) cancel(); // its motions are of another document
    open = id;
    if (document === seen) return;
    const first = seen === null;
    const meant = (each) => JSON.stringify([timelineOf(each).prompts, each.constraints, each.settings, each.seeds]);
    const same = !first && meant(seen) === meant(document);
    if (!first && seen.seeds.join() !== document.seeds.join()) scope = everything; // new seeds are for new motions
    seen = document;
    later("check", studio.quick() && !studio.dragging() ? 0 : CHECK_AFTER, check);
    if (same) return; // what waits still holds
    clearTimeout(timers.generate);
    if (live) return; // a stream plays it
    if (studio.knows(document, quality)) return cancel();
    if (!store.get().auto || !document.prompts.length) return;
    const delay = studio.quick() ? QUICKLY_AFTER : GENERATE_AFTER;
    later("generate", delay, function wait() {
      if (studio.dragging()) return later("generate", delay, wait);
      generate(scope);
      scope = afterEdit;
    });
  });

  return {
    generate: () => generate(),
    cancel,
    regeneratePrompt: (id) => regenerate((plan) => decidedBy(id, plan)),
    regenerateSpan: ({ start, end }) => regenerate(() => [{ start, end, parts: PARTS }]),
    argued,
  };
}

// A constraint as the server reads it.
export function argued({ id, kind, ...values }) {
  return { [kind]: values };
}
