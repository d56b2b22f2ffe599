// Keys of presenter mode, whatever has the focus, and buttons for those without a keyboard.

const TEXT = "input[type=text], input:not([type]), textarea";
const ACTIONS = {
  ArrowRight: "next",
  PageDown: "next", // of remote controls
  ArrowLeft: "back",
  PageUp: "back",
  r: "reveal",
  Escape: "end",
};

export function render({ model }) {
  const send = (what) => (model.pressed = [what, Date.now()]);
  const button = (label, help, act) => {
    const node = element("button", label, { type: "button", title: help, "aria-label": help });
    node.addEventListener("click", (event) => {
      if (event.detail > 0) node.blur(); // after a mouse click, so that Space does not press it again
      act();
    });
    return node;
  };
  const fill = () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen().catch(() => {});
  };
  const blank = element("div", "", { class: "blank", hidden: "" });
  const own = {
    " ": () => document.dispatchEvent(new Event("firstphoton:play")),
    f: fill,
    b: () => (blank.hidden = !blank.hidden),
  };

  const press = (event) => {
    const [target] = event.composedPath();
    const isTaken = event.defaultPrevented || event.ctrlKey || event.metaKey || event.altKey;
    if (isTaken || target.matches?.(TEXT)) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (key.startsWith("Arrow") && target.matches?.("input[type=range]")) return;
    if (key === " " && target.matches?.("button")) return;
    const what = model.digits.includes(key) ? key : ACTIONS[key];
    if (!what && !own[key]) return;
    event.preventDefault();
    what ? send(what) : own[key]();
  };
  addEventListener("keydown", press);
  model.on("remove", () => removeEventListener("keydown", press));

  const narrow = matchMedia("(width < 700px)");
  const measure = () => (model.is_narrow = narrow.matches);
  narrow.addEventListener("change", measure);
  model.on("remove", () => narrow.removeEventListener("change", measure));
  measure();

  const place = element("span", "", { role: "status", class: "place" });
  const root = element("nav", "", { "aria-label": "Slides" });
  const keys = `Space play · R reveal · F full screen · B blank · digit lesson`;
  root.append(
    button("←", "Back (←)", () => send("back")),
    place,
    button("→", "Next (→)", () => send("next")),
    element("span", keys, { class: "keys" }),
    button("×", "End the presentation (Esc)", () => send("end")),
    blank,
  );
  const show = () => (place.textContent = model.place);
  model.on("place", show);
  show();
  return root;
}
