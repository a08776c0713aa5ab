// Time: a cursor that plays, stops and is put somewhere. Knows how long it may go, and nothing of what is played.

export function createPlayer(durationOf) {
  const listeners = [];
  let time = 0;
  let playing = false;
  let before = null;
  let rested = 0; // seconds at the end
  const tell = () => listeners.forEach((listener) => listener(time, playing));

  function tick(now) {
    if (!playing) return (before = null);
    const passed = before === null ? 0 : Math.min((now - before) / 1000, 0.25);
    before = now;
    time += passed * player.speed;
    if (time >= durationOf()) {
      time = durationOf();
      rested += passed;
      if (player.waits) rested = 0;
      else if (!player.loops) playing = false;
      else if (rested >= player.rest) time = 0;
    } else rested = 0;
    tell();
    requestAnimationFrame(tick);
  }

  const player = {
    speed: 1,
    loops: true,
    rest: 0, // seconds for which the last frame stands before it begins again
    waits: false, // whether more is to come after the last frame
    time: () => time,
    playing: () => playing,
    listen: (listener) => listeners.push(listener),
    seek(seconds) {
      time = Math.max(0, seconds);
      tell();
    },
    play(on = !playing) {
      if (on === playing || (on && !durationOf() && !player.waits)) return;
      playing = on;
      if (on && !player.waits && time >= durationOf() - 0.01) time = 0;
      if (on) requestAnimationFrame(tick);
      tell();
    },
  };
  return player;
}
