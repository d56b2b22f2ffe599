// A labelled number: typed, dragged or stepped by keys, on a linear or logarithmic track.

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
  const [label, unit, field, reset, ask, zones, track, error, doubt, help] = [
    "label", "unit", "field", "reset", "ask", "zones", "track", "error", "doubt", "help",
  ].map((name) => root.querySelector("." + name));

  const rounded = (value) => model.parts ? Math.round(value * model.parts) / model.parts : value;

  // Position on the track <-> value.
  const toValue = (position) => {
    const { low, high, log, parts } = model;
    const share = position / Number(track.max);
    const value = log ? low * (high / low) ** share : low + (high - low) * share;
    return parts ? rounded(value) : Number(value.toPrecision(3));
  };
  const toPosition = (value) => {
    const { low, high, log } = model;
    const share = log ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low);
    return Math.round(Math.min(1, Math.max(0, share)) * Number(track.max));
  };
  const text = (value) => {
    if (value === null) return "";
    const [origin, step, decimals] = model.along;
    if (decimals !== null) return (origin + step * value).toFixed(decimals);
    const size = Math.abs(value);
    return size !== 0 && (size < 1e-4 || size >= 1e6) ? value.toExponential() : String(value);
  };

  const zone = ([from, to, why]) => {
    const [left, right] = [from, to].map((value) => (100 * toPosition(value)) / track.max);
    const node = document.createElement("div");
    node.className = "zone";
    node.style.cssText = `left: ${left}%; width: ${right - left}%`;
    node.title = why;
    return node;
  };

  const complain = (message) => {
    error.textContent = message;
    field.setAttribute("aria-invalid", message !== "");
  };
  const write = () => {
    field.value = text(model.value);
    complain("");
  };
  const show = () => {
    const { value, low, high, initial, parts, log, doubtful, substitute } = model;
    const effective = value ?? substitute;
    const empty = [model.empty, text(substitute)].filter(Boolean).join(" ");
    track.parentElement.hidden = model.optional && substitute === null;
    field.placeholder = model.optional ? empty : "";
    track.max = parts && !log ? Math.round((high - low) * parts) : STEPS;
    track.value = toPosition(effective);
    track.style.setProperty("--filled", `${(100 * track.value) / track.max}%`);
    track.setAttribute("aria-valuetext", `${text(effective)} ${model.unit}`);
    label.textContent = model.label;
    unit.textContent = model.unit && `(${model.unit})`;
    track.setAttribute("aria-label", `${model.label} ${unit.textContent}`.trim());
    const visible = doubtful
      .map(([from, to, why]) => [Math.max(from, low), Math.min(to, high), why])
      .filter(([from, to]) => from <= to);
    zones.replaceChildren(...visible.map(zone));
    doubt.textContent = doubtful
      .filter(([from, to]) => from <= value && value <= to)
      .map(([, , why]) => why)
      .join(" ");
    help.textContent = [
      `${model.help} ${text(low)} to ${text(high)} ${model.unit}`.trim() + ".",
      ...visible.map(([from, to, why]) => `Unreliable from ${text(from)} to ${text(to)}: ${why}`),
    ].join(" ");
    ask.title = help.textContent;
    ask.setAttribute("aria-label", `Help on ${model.label}`);
    track.title = model.help;
    const initially = text(initial) || empty;
    reset.title = `Reset to ${initially}`;
    reset.setAttribute("aria-label", `Reset ${model.label} to ${initially}`);
    reset.style.visibility = value === initial ? "hidden" : "visible";
  };
  const set = (value) => {
    window.firstphotonInput = performance.now(); // start of the response time, see facts.js
    model.value = value;
    show();
    write();
  };

  track.setAttribute("aria-describedby", "help doubt");
  track.addEventListener("input", () => {
    const value = toValue(track.value);
    if (value !== model.value) set(value);
  });
  field.addEventListener("change", () => {
    const { low, high, whole } = model;
    const [origin, step, decimals] = model.along;
    const typed = field.value.trim();
    const number = Number(typed.replace(",", "."));
    const value = decimals === null ? number : rounded((number - origin) / step);
    const isWhole = decimals === null ? whole : decimals === 0;
    if (typed === "" && model.optional) {
      set(null);
    } else if (typed !== "" && value >= low && value <= high && !(isWhole && number % 1)) {
      set(value);
    } else {
      const kind = isWhole ? "a whole number" : "a number";
      complain(`“${typed}” is not accepted: enter ${kind} from ${text(low)} to ${text(high)}.`);
    }
  });
  field.addEventListener("keydown", ({ key }) => key === "Escape" && write());
  reset.addEventListener("click", () => set(model.initial));
  ask.addEventListener("click", () => {
    help.hidden = !help.hidden;
    ask.setAttribute("aria-expanded", String(!help.hidden));
  });

  const written = ["value", "low", "high", "along"]; // the others leave what is being typed
  model.on([...written, "initial", "label", "doubtful", "empty", "substitute"], show);
  model.on(written, write);
  show();
  write();
  return root;
}
