// A card that points at parts of the page, one after another. The page below it stays usable.

const RECORD = "firstphoton.tour"; // kept by the browser once the tour was ended
const SEEK_MS = 250; // time after which a part is looked for again: pages change
const GAP_PX = 8;

// The first element that is on screen; those of Panel are in shadow roots.
function visible(selector, root = document) {
  for (const each of root.querySelectorAll(selector)) {
    const { width, right } = each.getBoundingClientRect();
    if (width > 0 && right > 0) return each;
  }
  for (const { shadowRoot } of root.querySelectorAll("*")) {
    const found = shadowRoot && visible(selector, shadowRoot);
    if (found) return found;
  }
  return null;
}

function focused(root = document) {
  const inner = root.activeElement?.shadowRoot;
  return inner ? focused(inner) : root.activeElement;
}

function isEnded() {
  try {
    return localStorage.getItem(RECORD) !== null;
  } catch {
    return false; // the browser keeps nothing
  }
}

export function render({ model }) {
  let at = -1; // the present stop; -1 when there is none
  let target = null; // the part to which it points
  let isNew = true; // whether it has not been scrolled to
  let sought = 0;
  let opener = null; // what had the focus before

  const button = (label, help, act) => {
    const node = element("button", label, { type: "button", title: help });
    node.addEventListener("click", act);
    return node;
  };
  const frame = element("div", "", { class: "frame", popover: "manual" });
  const title = element("h2");
  const text = element("p");
  const said = element("div", "", { "aria-live": "polite" });
  said.append(title, text);
  const place = element("span", "", { class: "place" });
  const back = button("Back", "Previous stop", () => show(at - 1));
  const next = button("Next", "Next stop", () => (isLast() ? finish() : show(at + 1)));
  const close = button("End", "End the tour (Esc)", () => end());
  const row = element("footer");
  row.append(place, close, back, next);
  const card = element("section", "", { popover: "manual", "aria-label": "Tour" });
  card.append(said, row);
  const root = element("div");
  root.append(frame, card);

  const isLast = () => at === model.stops.length - 1;

  const show = (stop) => {
    [at, target, isNew, sought] = [stop, null, true, 0];
    const [, heading, sentence] = model.stops[at];
    title.textContent = heading;
    text.textContent = sentence;
    place.textContent = `${at + 1} / ${model.stops.length}`;
    back.disabled = at === 0;
    next.textContent = isLast() ? model.onward : "Next";
  };

  const follow = (now) => {
    if (at < 0) return;
    if (now - sought > SEEK_MS) {
      const [selectors] = model.stops[at];
      const isHere = visible(model.shown_with); // else another page is on screen
      target = isHere && selectors.map((each) => visible(each)).find(Boolean);
      sought = now;
    }
    for (const each of [frame, card]) each.togglePopover(Boolean(target));
    if (target) point(target.getBoundingClientRect());
    requestAnimationFrame(follow);
  };

  const point = ({ left, top, right, bottom, width, height }) => {
    const isOutside = top < 0 || bottom > innerHeight;
    if (isNew && isOutside) target.scrollIntoView({ block: "center" });
    isNew = false;
    const px = (values) => values.map((each) => `${each}px`).join(" ");
    Object.assign(frame.style, {
      translate: px([left - GAP_PX / 2, top - GAP_PX / 2]),
      width: px([width + GAP_PX]),
      height: px([height + GAP_PX]),
    });
    // Below the part, or else above it, or else over its end.
    const { offsetWidth, offsetHeight } = card;
    const lowest = innerHeight - offsetHeight - GAP_PX;
    const above = top - GAP_PX - offsetHeight;
    const y = bottom + GAP_PX <= lowest ? bottom + GAP_PX : above >= GAP_PX ? above : lowest;
    const x = Math.max(GAP_PX, Math.min(left, innerWidth - offsetWidth - GAP_PX));
    card.style.translate = px([x, y]);
  };

  const start = () => {
    // Panel may render a component twice; only the copy on the page answers.
    if (!root.isConnected || at >= 0) return;
    show(0);
    requestAnimationFrame(follow);
  };
  const end = () => {
    at = -1;
    for (const each of [frame, card]) each.hidePopover();
    opener?.focus();
    opener = null;
    try {
      localStorage.setItem(RECORD, "ended");
    } catch {} // it is offered again
  };
  const finish = () => {
    opener = null;
    end();
    model.finished += 1;
  };

  const press = (event) => {
    if (at >= 0 && event.key === "Escape" && !event.defaultPrevented) end();
  };
  const restart = () => {
    opener = focused();
    start();
    requestAnimationFrame(() => next.focus());
  };
  document.addEventListener("keydown", press);
  model.on("started", restart);
  model.on("remove", () => {
    at = -1;
    document.removeEventListener("keydown", press);
  });
  if (model.is_offered && !location.search && !isEnded()) requestAnimationFrame(start);
  return root;
}
