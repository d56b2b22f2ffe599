// Fills a histogram pulse by pulse: the sources of its figure are changed here, and the change is
// not sent to the server.

const FIRST_PER_S = 3; // pulses while there are few
const GROWTH_PER_S = 0.6; // share of the pulses so far
const MOST_FRAME_S = 0.1; // a tab in the background draws no frames
const HELP = "Space: play or pause · →: one pulse · Home: restart";
const LEAST_TOP = 4; // counts

const button = (label, help, act) => {
  const node = element("button", label, { type: "button", title: help });
  node.addEventListener("click", act);
  return node;
};

const number = (value) => value.toLocaleString("en");

// A few steps per decade, so that the axis seldom changes.
function roundUp(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * [1, 1.5, 2, 3, 4, 5, 6, 8, 10].find((step) => step * power >= value);
}

export function render({ model }) {
  let [photons, ends, probability] = [[], [], []];
  let counts = new Float32Array();
  let shown = 1; // pulses
  let position = 1; // the same, with a fraction while it plays
  let frame = null; // the request for the next one while it plays
  let before = null; // time of the last one

  const readData = () => {
    photons = new Float32Array(model.times ?? 0);
    ends = new Int32Array(model.ends ?? 0);
    probability = new Float32Array(model.probability ?? 0);
  };
  const find = (name) =>
    Bokeh.documents.map((each) => each.get_model_by_id(model.models[name])).find(Boolean);
  const set = (name, values) => find(name)?.setv(values, { sync: false, check_eq: false });
  const photonsOf = (pulse) => photons.subarray(pulse ? ends[pulse - 1] : 0, ends[pulse]);

  // Counts are recomputed from the first pulse only where pulses are taken away.
  const count = (from, to) => {
    if (from === 0) counts = new Float32Array(probability.length);
    for (let pulse = from; pulse < to; pulse++) {
      const [first] = photonsOf(pulse);
      if (first !== undefined) counts[Math.floor(first)] += 1;
    }
  };
  // Without a point, its symbol would be missing in the legend.
  const strip = (at) => at.length ? { x: [...at], y: Array(at.length).fill(0.93) } : { x: [NaN], y: [NaN] };
  const draw = () => {
    const x = probability.map((_, bin) => bin + 0.5);
    const own = photonsOf(shown - 1);
    const most = counts.reduce((high, each) => Math.max(high, each), 1);
    set("histogram", { data: { x, top: counts.slice() } });
    set("expected", { data: { x, y: probability.map((each) => each * shown) } });
    set("first photon", { data: strip(own.subarray(0, 1)) });
    set("later photons", { data: strip(own.subarray(1)) });
    set("counts", { end: roundUp(Math.max(1.3 * most, LEAST_TOP)) });
    const fired = counts.reduce((sum, each) => sum + each, 0);
    const found = own.length
      ? `first photon in bin ${Math.floor(own[0])}, ${own.length - 1} later lost`
      : "no photon";
    status.textContent =
      `Pulse ${number(shown)} of ${number(ends.length)}: ${found}. ` +
      `${number(fired)} counted so far.`;
  };
  const go = (to) => {
    const next = Math.min(Math.max(Math.floor(to), 1), ends.length);
    if (next === shown) return;
    count(next > shown ? shown : 0, next);
    shown = next;
    draw();
  };

  const isCalm = () => matchMedia("(prefers-reduced-motion: reduce)").matches;
  const isAtEnd = () => shown === ends.length;
  const label = () => {
    const isPlaying = frame !== null;
    play.textContent = isPlaying ? "Pause" : isCalm() ? "Show all" : "Play";
    one.disabled = isAtEnd();
    // Screen readers hear where it stops, not each pulse of a film.
    status.setAttribute("aria-live", isPlaying ? "off" : "polite");
  };
  const stop = () => {
    cancelAnimationFrame(frame);
    frame = before = null;
    label();
  };
  const next = (now) => {
    const passed_s = Math.min((now - (before ?? now)) / 1000, MOST_FRAME_S);
    before = now;
    position += passed_s * Math.max(FIRST_PER_S, GROWTH_PER_S * position);
    go(position);
    if (isAtEnd()) stop();
    else frame = requestAnimationFrame(next);
  };
  const toggle = () => {
    if (frame !== null) return stop();
    if (isAtEnd()) go(1);
    position = shown;
    if (isCalm()) go(ends.length);
    else frame = requestAnimationFrame(next);
    label();
  };
  const jump = (to) => {
    stop();
    go(to);
    label();
  };

  const play = button("Play", "Play or pause (Space)", toggle);
  const one = button("One pulse", "Add one pulse (→)", () => jump(shown + 1));
  const restart = button("Restart", "Show the first pulse alone (Home)", () => jump(1));
  const status = element("p", "", { role: "status" });
  const root = element("div", "", {
    class: "player",
    tabindex: "0",
    role: "group",
    "aria-label": `Histogram that fills pulse by pulse. ${HELP}`,
  });
  root.append(play, one, restart, element("small", HELP), status);
  const KEYS = {
    " ": toggle,
    ArrowRight: () => jump(shown + 1),
    Home: () => jump(1),
  };
  root.addEventListener("keydown", (event) => {
    const isOfButton = event.key === " " && event.target !== root;
    if (isOfButton || !(event.key in KEYS)) return;
    event.preventDefault();
    KEYS[event.key]();
  });

  // New photons: keep the number of pulses shown. Values change together: draw once.
  let isDue = false;
  const renew = () => {
    isDue = false;
    readData();
    if (ends.length === 0) return;
    shown = Math.min(shown, ends.length);
    count(0, shown);
    draw();
    label();
  };
  model.on(["times", "ends", "probability", "models"], () => {
    if (!isDue) queueMicrotask(renew);
    isDue = true;
  });
  const playHere = () => root.getClientRects().length > 0 && toggle();
  document.addEventListener("firstphoton:play", playHere); // of presenter mode
  model.on("remove", () => {
    stop();
    document.removeEventListener("firstphoton:play", playHere);
  });
  renew();
  return root;
}
