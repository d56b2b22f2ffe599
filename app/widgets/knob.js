// A labelled number: typed, dragged or stepped by keys; on a linear or a logarithmic track.

const STEPS = 400; // positions of the track

export function render({ model }) {
  const root = document.createElement("div");
  root.className = "knob";
  root.innerHTML = `
    <div class="head">
      <label class="label" for="field"></label>
      <span class="unit"></span>
      <input id="field" class="field" type="text" inputmode="decimal" autocomplete="off">
      <button class="reset" type="button">↺</button>
      <button class="ask" type="button" aria-expanded="false">?</button>
    </div>
    <div class="rail"><div class="zones"></div><input class="track" type="range"></div>
    <div class="error" role="alert"></div>
    <div class="doubt" id="doubt" role="status"></div>
    <div class="help" id="help" hidden></div>`;
  const part = (name) => root.querySelector("." + name);
  const [field, track, error, help, ask, zones, doubt] =
    ["field", "track", "error", "help", "ask", "zones", "doubt"].map(part);

  // Position on the track <-> value.
  const toValue = (position) => {
    const { low, high, log, whole } = model;
    const share = position / Number(track.max);
    const value = log ? low * (high / low) ** share : low + (high - low) * share;
    return whole ? Math.round(value) : Number(value.toPrecision(3));
  };
  const toPosition = (value) => {
    const { low, high, log } = model;
    const share = log ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low);
    return Math.round(Math.min(1, Math.max(0, share)) * Number(track.max));
  };
  const text = (value) => {
    const size = Math.abs(value);
    return size !== 0 && (size < 1e-3 || size >= 1e6) ? value.toExponential() : String(value);
  };

  // Values in doubt, as far as the track reaches.
  const reached = () =>
    model.doubtful
      .map(([from, to, why]) => [Math.max(from, model.low), Math.min(to, model.high), why])
      .filter(([from, to]) => from <= to);
  const mark = () => {
    zones.replaceChildren(
      ...reached().map(([from, to, why]) => {
        const [left, right] = [from, to].map((at) => (100 * toPosition(at)) / track.max);
        const zone = document.createElement("div");
        zone.className = "zone";
        zone.style.cssText = `left: ${left}%; width: ${right - left}%`;
        zone.title = why;
        return zone;
      }),
    );
  };
  const doubts = (value) =>
    model.doubtful.filter(([from, to]) => from <= value && value <= to).map(([, , why]) => why);

  const show = () => {
    const { value, low, high, label, unit, whole, log } = model;
    track.min = 0;
    track.max = whole && !log ? high - low : STEPS;
    track.step = 1;
    track.value = toPosition(value);
    field.value = text(value);
    part("label").textContent = label;
    part("unit").textContent = unit ? `(${unit})` : "";
    const inDoubt = reached().map(
      ([from, to, why]) => ` In doubt from ${text(from)} to ${text(to)}: ${why}`,
    );
    help.textContent =
      `${model.help} ${text(low)} to ${text(high)}${unit ? " " + unit : ""}.` + inDoubt.join("");
    mark();
    doubt.textContent = doubts(value).join(" ");
    track.setAttribute("aria-label", unit ? `${label} (${unit})` : label);
    track.setAttribute("aria-valuetext", `${text(value)} ${unit}`);
    track.setAttribute("aria-describedby", "help doubt");
    track.title = model.help;
    track.style.setProperty("--filled", `${(100 * track.value) / track.max}%`);
    part("reset").setAttribute("aria-label", `Reset ${label} to ${text(model.initial)}`);
    part("reset").title = `Reset to ${text(model.initial)}`;
    part("reset").style.visibility = value === model.initial ? "hidden" : "visible";
    ask.setAttribute("aria-label", `What is ${label}?`);
    ask.title = help.textContent;
    complain("");
  };
  const complain = (message) => {
    error.textContent = message;
    field.setAttribute("aria-invalid", message !== "");
  };
  const set = (value) => {
    window.firstphotonInput = performance.now(); // where the page's own stopwatch starts
    model.value = value;
    show();
  };

  track.addEventListener("input", () => {
    const value = toValue(track.value);
    if (value !== model.value) set(value);
  });
  const typed = () => {
    const value = Number(field.value.trim().replace(",", "."));
    const { low, high, whole } = model;
    const allowed = `${whole ? "a whole number " : ""}from ${text(low)} to ${text(high)}`;
    if (field.value.trim() === "" || !(value >= low && value <= high) || (whole && value % 1)) {
      complain(`${field.value || "Nothing"} is not possible here: give ${allowed}.`);
    } else {
      set(value);
    }
  };
  field.addEventListener("change", typed);
  field.addEventListener("keydown", (event) => {
    if (event.key === "Escape") show();
  });
  part("reset").addEventListener("click", () => set(model.initial));
  ask.addEventListener("click", () => {
    help.hidden = !help.hidden;
    ask.setAttribute("aria-expanded", String(!help.hidden));
  });

  for (const name of ["value", "low", "high", "initial", "label", "doubtful"]) model.on(name, show);
  show();
  return root;
}
