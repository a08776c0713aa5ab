// A motion on the stage, and its timeline below in step with it. "#t=2.5" in the address begins there, paused.

import { partColour } from "./studio/colours.js";
import { learn } from "./studio/constraints.js";
import { find, roomStyle } from "./studio/dom.js";
import { bytesOf, figureOf } from "./studio/figure.js";
import { createPlayer } from "./studio/player.js";
import { createStage } from "./studio/stage.js";
import { createTimelineBar, createTransport, playedByKey } from "./studio/transport.js";

const REST = 0.5; // seconds for which the last frame stands before the motion begins again

async function start() {
  const motion = JSON.parse(find("motion").textContent);
  const { duration, owners, transitions, marks } = motion;
  const colours = new Map(motion.colours.map((colour, index) => [index, colour]));
  const stage = createStage(find("stage"));
  const figure = await figureOf(bytesOf(motion.figure));
  const whole = figure.bounds(false);
  const player = createPlayer(() => duration);
  player.rest = REST;

  learn(motion.kinds);
  stage.show([{ key: "motion", figure }], "motion");
  stage.colour((part, time) => partColour(owners[part], transitions[part], Math.min(time, duration - 1e-3), colours));
  stage.mark(marks, null);
  stage.aim(null, motion.heading);
  const wear = () => stage.theme(roomStyle());
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", wear);
  wear();

  player.listen((time) => {
    stage.at(time);
    document.body.dataset.time = time.toFixed(3);
  });
  createTransport(player, () => duration);
  if (find("tracks")) createTimelineBar(find("tracks"), find("ruler"), find("cursor"), player, () => duration);

  function toggleFollow() {
    const follows = find("follow").getAttribute("aria-pressed") !== "true";
    find("follow").setAttribute("aria-pressed", String(follows));
    stage.follow(follows);
    stage.aim(follows ? null : whole);
  }
  find("follow").onclick = toggleFollow;
  find("reset-view").onclick = () => stage.reset();
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "f") toggleFollow();
    else if (!playedByKey(event, player, () => duration)) return;
    event.preventDefault();
  });

  const wanted = /[#&]t=([0-9.]+)/.exec(location.hash);
  player.seek(wanted ? Math.min(Number(wanted[1]) || 0, duration) : 0);
  if (!wanted && !matchMedia("(prefers-reduced-motion: reduce)").matches) player.play(true);
  document.body.dataset.ready = "true";
}

start().catch((error) => {
  find("empty").textContent = `The motion cannot be shown: ${error.message}`;
});
