// What people hold a player by: its buttons, a slider, a bar beneath texts that moves with time, keys. Knows the ids that
// all pages give them; knows no motion.

import { find } from "./dom.js";

// The buttons "play", "loop", "speed" and "seek" and the "time" of a page; `show` brings them up to date.
export function createTransport(player, durationOf) {
  const [play, loop, speed, seek, clock] = ["play", "loop", "speed", "seek", "time"].map(find);

  function show(time = player.time(), playing = player.playing()) {
    clock.textContent = `${time.toFixed(2)} / ${durationOf().toFixed(2)} s`;
    seek.max = durationOf();
    seek.value = time;
    if (play.dataset.playing === String(playing)) return;
    play.dataset.playing = String(playing);
    play.setAttribute("aria-label", playing ? "Pause" : "Play");
    play.querySelector("use").setAttribute("href", playing ? "#icon-pause" : "#icon-play");
  }

  player.listen(show);
  play.onclick = () => player.play();
  seek.oninput = () => player.seek(seek.valueAsNumber);
  speed.onchange = () => (player.speed = Number(speed.value));
  if (loop)
    loop.onclick = () => {
      player.loops = !player.loops;
      loop.setAttribute("aria-pressed", String(player.loops));
    };
  show();
  return { show };
}

// A cursor over `host` that a hand drags: `lane` lies within and is as wide as all seconds. What has data-from and
// data-to is marked while it holds: bars are "now", others are to be seen.
export function createTimelineBar(host, lane, cursor, player, durationOf) {
  let held = false;

  function show(time = player.time()) {
    const within = lane.getBoundingClientRect();
    const left = within.left - host.getBoundingClientRect().left - host.clientLeft;
    cursor.style.left = `${left + (within.width * time) / (durationOf() || 1)}px`;
    for (const element of document.querySelectorAll("[data-from]")) {
      const now = Number(element.dataset.from) <= time && time < Number(element.dataset.to);
      if (element.classList.contains("bar")) element.classList.toggle("now", now);
      else element.hidden = !now;
    }
  }

  function drag(event) {
    const { left, width } = lane.getBoundingClientRect();
    if (held) player.seek(Math.min(Math.max((event.clientX - left) / width, 0), 1) * durationOf());
  }

  host.addEventListener("pointerdown", (event) => {
    held = event.clientX >= lane.getBoundingClientRect().left;
    if (held) host.setPointerCapture(event.pointerId);
    drag(event);
  });
  host.addEventListener("pointermove", drag);
  for (const end of ["pointerup", "pointercancel"]) host.addEventListener(end, () => (held = false));
  player.listen(show);
  new ResizeObserver(() => show()).observe(lane);
  return { show };
}

// Space plays and pauses; the arrows go a quarter of a second back and on. Answers whether the key was one of them.
export function playedByKey({ key, target }, player, durationOf) {
  const step = { ArrowLeft: -0.25, ArrowRight: 0.25 }[key];
  if (key === " " && !target.matches("button, select, [type=radio]:not(:checked)")) player.play();
  else if (step && !target.matches("select, [type=radio], [type=range]")) player.seek(Math.min(player.time() + step, durationOf()));
  else return false;
  return true;
}
