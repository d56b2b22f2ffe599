// A quiet button in the corner of a card, and a menu of the formats in which what the card shows can
// be taken away. Pictures are made here, of what is on screen; other files come from the server, a
// piece at a time, each asked for when the last has arrived.

const ICON = "M12 3v12m-5-5l5 5 5-5M4 20h16";
const FONT = "Roboto, system-ui, sans-serif";
const HEADING_PX = 26;
const SCALE_PX = 44;
const MARGIN_PX = 10;

const STYLE = `
.download > button {
  all: unset; box-sizing: border-box; display: block; width: 24px; height: 24px; padding: 4px;
  border-radius: 6px; cursor: pointer; opacity: 0.55;
  color: var(--mui-palette-text-primary, #1c2430);
  background: var(--mui-palette-background-paper, #fff);
}
.download > button:hover, .download > button:focus-visible, .download > button[aria-expanded="true"] {
  opacity: 1;
  background: color-mix(in srgb, currentColor 12%, var(--mui-palette-background-paper, #fff));
}
.download > button:focus-visible { outline: 2px solid #4c8dff; }
.download > button[aria-busy="true"] { cursor: progress; animation: waiting 1s infinite alternate; }
@keyframes waiting { to { opacity: 0.15; } }
@media (prefers-reduced-motion: reduce) { .download > button[aria-busy="true"] { animation: none; } }
.download svg {
  display: block; width: 16px; height: 16px; fill: none; stroke: currentColor; stroke-width: 1.9;
  stroke-linecap: round; stroke-linejoin: round;
}
[role="menu"] {
  position: fixed; inset: auto; margin: 0; padding: 4px; border-radius: 6px;
  border: 1px solid var(--mui-palette-divider, #d5dbe2);
  background: var(--mui-palette-background-paper, #fff);
  color: var(--mui-palette-text-primary, #1c2430);
  box-shadow: 0 4px 16px #0004;
  font: 13px/1.3 var(--mui-font-family, Roboto, system-ui, sans-serif);
}
[role="menuitem"] {
  all: unset; box-sizing: border-box; display: grid; grid-template-columns: 42px auto; gap: 4px;
  width: 100%; padding: 5px 10px 5px 8px; border-radius: 4px; cursor: pointer;
}
[role="menuitem"] span { color: var(--mui-palette-text-secondary, #5a6675); }
[role="menuitem"]:hover, [role="menuitem"]:focus-visible {
  background: color-mix(in srgb, currentColor 12%, transparent);
}
[role="menuitem"]:focus-visible { outline: 2px solid #4c8dff; outline-offset: -2px; }
.status { position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); }`;

const element = (tag, text = "", attributes = {}) => {
  const node = document.createElement(tag);
  node.textContent = text;
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  return node;
};

// ------------------------------------------------------------------------------ what is on screen

function* within(view) {
  yield view;
  for (const child of view.child_views ?? []) yield* within(child);
}

// The plots and clouds of a card that can be seen.
function seen(card) {
  const views = [...within(card)].filter(({ el }) => el.getClientRects().length > 0);
  const plots = views.filter(({ model }) => model.type === "Figure");
  const clouds = views.map(({ shadow_el }) => shadow_el.querySelector(".cloud"));
  return { plots, clouds: clouds.filter((cloud) => cloud?.picture) };
}

// --------------------------------------------------------------------------------------- pictures

// Something to draw on, in pixels of the page, that becomes a file.
function canvasSheet(width, height, ratio) {
  const canvas = element("canvas", "", { width: width * ratio, height: height * ratio });
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  const blob = () =>
    new Promise((done, fail) =>
      canvas.toBlob((made) => (made ? done(made) : fail(new Error("it is too large"))), "image/png"),
    );
  return { pen, blob };
}

function svgSheet(Layer, width, height, name, about) {
  const layer = new Layer("svg", false);
  layer.resize(width, height);
  const root = layer.ctx.get_svg();
  const told = { title: name, desc: about };
  for (const [tag, text] of Object.entries(told).reverse()) {
    const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
    node.textContent = text;
    root.prepend(node);
  }
  const blob = () => {
    keepWidths(root);
    return layer.to_blob();
  };
  return { pen: layer.ctx, blob };
}

// Texts as wide as here, where the reader's machine lacks the font: legends would overlap.
function keepWidths(root) {
  const pen = element("canvas").getContext("2d");
  for (const text of root.querySelectorAll("text")) {
    const [style, weight, size, family] = ["style", "weight", "size", "family"].map(
      (name) => text.getAttribute(`font-${name}`) ?? "",
    );
    pen.font = `${style} ${weight} ${size} ${family}`;
    text.setAttribute("textLength", pen.measureText(text.textContent).width.toFixed(1));
    text.setAttribute("lengthAdjust", "spacingAndGlyphs");
  }
}

// The picture of a card, with a heading and a colour scale where those stand elsewhere on the page.
async function pictureOf(card, { suffix, name, about, heading, scale }) {
  const { plots, clouds } = seen(card);
  const layers = plots.map((plot) => plot.export(suffix));
  const parts = [
    ...layers.map(({ canvas, bbox: { width, height } }) => ({ canvas, width, height })),
    ...clouds.map((cloud) => cloud.picture()),
  ];
  if (parts.length === 0) throw new Error("nothing is drawn here yet");
  const width = Math.max(...parts.map((part) => part.width));
  const [above, below] = [heading ? HEADING_PX : 0, scale ? SCALE_PX : 0];
  const height = parts.reduce((sum, part) => sum + part.height, above + below);
  const { pen, blob } =
    suffix === "svg"
      ? svgSheet(layers[0].constructor, width, height, name, about)
      : canvasSheet(width, height, parts[0].canvas.width / parts[0].width);
  const { backgroundColor: paper, color: ink } = getComputedStyle(card.el);
  pen.fillStyle = paper;
  pen.fillRect(0, 0, width, height);
  pen.fillStyle = ink;
  if (heading) write(pen, heading, MARGIN_PX, above / 2 + 2, "left", `600 13px ${FONT}`, width);
  let top = above;
  for (const part of parts) {
    if (suffix === "svg") pen.drawImage(part.canvas, 0, top);
    else pen.drawImage(part.canvas, 0, top, part.width, part.height);
    top += part.height;
  }
  if (scale) drawScale(pen, scale, top, width);
  return suffix === "png" ? withText(await blob(), { Title: name, Description: about }) : blob();
}

function write(pen, text, x, y, align, font, room) {
  pen.font = font;
  pen.textAlign = align;
  pen.textBaseline = "middle";
  pen.fillText(text, x, y, room - 2 * MARGIN_PX);
}

function drawScale(pen, { title, low, high, colors }, top, width) {
  const ink = pen.fillStyle;
  const [length, font] = [width - 2 * MARGIN_PX, `11px ${FONT}`];
  colors.forEach((color, place) => {
    pen.fillStyle = color;
    const left = (place * length) / colors.length;
    // Each reaches under the next: no seam is left between two.
    pen.fillRect(MARGIN_PX + left, top + 6, length - left, 9);
  });
  pen.fillStyle = ink;
  const [line, right] = [top + 26, MARGIN_PX + length];
  write(pen, low, MARGIN_PX, line, "left", font, width);
  write(pen, high, right, line, "right", font, width);
  write(pen, title, width / 2, top + 38, "center", font, width);
}

// A PNG with texts (chunks iTXt, in UTF-8) behind its header.
async function withText(png, texts) {
  const header = 33; // signature and first chunk
  const chunks = Object.entries(texts).map(([key, text]) => textChunk(key, text));
  return new Blob([png.slice(0, header), ...chunks, png.slice(header)], { type: "image/png" });
}

function textChunk(key, text) {
  const body = new TextEncoder().encode(`iTXt${key}\0\0\0\0\0${text}`);
  const chunk = new Uint8Array(body.length + 8);
  const numbers = new DataView(chunk.buffer);
  numbers.setUint32(0, body.length - 4);
  chunk.set(body, 4);
  numbers.setUint32(body.length + 4, checksum(body));
  return chunk;
}

// CRC-32, as PNG asks for it.
function checksum(bytes) {
  let sum = ~0;
  for (const byte of bytes) {
    sum ^= byte;
    for (let bit = 0; bit < 8; bit++) sum = (sum >>> 1) ^ (sum & 1 ? 0xedb88320 : 0);
  }
  return ~sum >>> 0;
}

// ------------------------------------------------------------------------------------------ files

function save(blob, name) {
  const link = element("a", "", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

// --------------------------------------------------------------------------------- button and menu

export function render({ model, view }) {
  const button = element("button", "", { type: "button" });
  button.innerHTML = `<svg viewBox="0 0 24 24" aria-hidden="true"><path d="${ICON}"/></svg>`;
  const menu = element("div", "", { role: "menu", popover: "auto" });
  const status = element("div", "", { class: "status", role: "status" });
  button.setAttribute("aria-haspopup", "menu");
  button.popoverTargetElement = menu;

  let pieces = [];
  const settle = (text = "") => {
    pieces = [];
    button.removeAttribute("aria-busy");
    button.popoverTargetElement = menu;
    status.textContent = text;
  };
  const close = () => {
    menu.hidePopover();
    button.focus();
  };
  const ask = (suffix) => {
    close();
    button.setAttribute("aria-busy", "true");
    button.popoverTargetElement = null; // not disabled: it keeps the keyboard
    status.textContent = `Preparing ${suffix.toUpperCase()} …`;
    model.send_msg({ suffix });
  };
  let items = [];
  const entry = ([suffix, help]) => {
    const item = element("button", "", { type: "button", role: "menuitem", tabindex: "-1" });
    item.append(element("b", suffix.toUpperCase()), element("span", help));
    item.addEventListener("click", () => ask(suffix));
    return item;
  };
  const list = () => {
    items = model.formats.map(entry);
    menu.replaceChildren(...items);
  };
  const name = () => {
    button.title = `Download: ${model.what}`;
    for (const part of [button, menu]) part.setAttribute("aria-label", button.title);
  };
  model.on("formats", list);
  model.on("what", name);
  list();
  name();

  menu.addEventListener("toggle", ({ newState }) => {
    const isOpen = newState === "open";
    button.setAttribute("aria-expanded", String(isOpen));
    if (!isOpen) return;
    const [at, size] = [button.getBoundingClientRect(), menu.getBoundingClientRect()];
    menu.style.left = `${Math.max(4, at.right - size.width)}px`;
    const isRoom = at.bottom + size.height + 4 < window.innerHeight;
    menu.style.top = `${isRoom ? at.bottom + 2 : Math.max(4, at.top - size.height - 2)}px`;
    items[0].focus();
  });
  button.addEventListener("keydown", (event) => {
    if (event.key !== "ArrowDown" || button.popoverTargetElement === null) return;
    event.preventDefault();
    menu.showPopover();
  });
  menu.addEventListener("keydown", (event) => {
    const place = items.indexOf(menu.getRootNode().activeElement);
    const last = items.length - 1;
    const moves = { ArrowDown: place + 1, ArrowUp: place - 1, Home: 0, End: last };
    event.stopPropagation(); // arrow keys move pixels elsewhere
    if (event.key === "Tab" || event.key === "Escape") close();
    if (!(event.key in moves)) return;
    event.preventDefault();
    items[(moves[event.key] + items.length) % items.length].focus();
  });

  model.on("msg:custom", async (told) => {
    if (told.failed) {
      settle();
    } else if (told.picture) {
      try {
        save(await pictureOf(view.parent, told.picture), told.picture.name);
        settle(`Saved ${told.picture.name}`);
      } catch (error) {
        settle();
        model.send_msg({ failed: error.message });
      }
    } else {
      pieces.push(told.piece);
      const got = pieces.reduce((sum, piece) => sum + piece.byteLength, 0);
      if (got < told.size) {
        model.send_msg({ from: got });
      } else {
        save(new Blob(pieces), told.name);
        settle(`Saved ${told.name}`);
      }
    }
  });

  const root = element("div", "", { class: "download" });
  root.append(element("style", STYLE), button, menu, status);
  return root;
}
