// A button in the corner of a card, with a menu of the formats in which its content can be saved.
// Pictures are made here, from what is on screen; other files come from the server in pieces, each
// requested when the previous one has arrived.

const ICON = "M12 3v12m-5-5l5 5 5-5M4 20h16";
const FONT = "Roboto, system-ui, sans-serif";
const PICTURE_PX = 1200; // least width of a PNG
const HEADING_PX = 26;
const SCALE_PX = 44;
const MARGIN_PX = 10;

const STYLE = `
.download > button, [role="menuitem"] { all: unset; box-sizing: border-box; cursor: pointer; }
.download > button {
  display: block; width: 24px; height: 24px; padding: 4px; border-radius: 6px; opacity: 0.55;
  color: var(--mui-palette-text-primary, #1c2430);
  background: var(--mui-palette-background-paper, #fff);
}
.download > button:hover, .download > button:focus-visible, .download > button[aria-expanded="true"] {
  opacity: 1;
}
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
  display: grid; grid-template-columns: 42px auto; gap: 4px; width: 100%; padding: 5px 10px 5px 8px;
  border-radius: 4px;
}
[role="menuitem"] span { color: var(--mui-palette-text-secondary, #5a6675); }
button:hover, button:focus-visible {
  background: color-mix(in srgb, currentColor 12%, var(--mui-palette-background-paper, #fff));
}
button:focus-visible { outline: 2px solid #4c8dff; outline-offset: -2px; }
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

// The visible plots and clouds of a card.
function contentOf(card) {
  const views = [...within(card)].filter(({ el }) => el.getClientRects().length > 0);
  const plots = views.filter(({ model }) => model.type === "Figure");
  const clouds = views.map(({ shadow_el }) => shadow_el.querySelector(".cloud"));
  return { plots, clouds: clouds.filter((cloud) => cloud?.picture) };
}

// --------------------------------------------------------------------------------------- pictures

// A pen that draws in CSS pixels, and a function that returns the drawing as a PNG.
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

// The same for SVG, with Bokeh's own layer.
function svgSheet(Layer, width, height, texts) {
  const layer = new Layer("svg", false);
  layer.resize(width, height);
  const root = layer.ctx.get_svg();
  const described = Object.entries(texts).map(([tag, text]) => {
    const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
    node.textContent = text;
    return node;
  });
  root.prepend(...described);
  const blob = () => {
    keepWidths(root);
    return layer.to_blob();
  };
  return { pen: layer.ctx, blob };
}

// Fix the widths of texts: legends would overlap where the reader's machine lacks the font.
function keepWidths(root) {
  const pen = element("canvas").getContext("2d");
  for (const text of root.querySelectorAll("text")) {
    const names = ["style", "weight", "size", "family"];
    pen.font = names.map((name) => text.getAttribute(`font-${name}`) ?? "").join(" ");
    text.setAttribute("textLength", pen.measureText(text.textContent).width.toFixed(1));
    text.setAttribute("lengthAdjust", "spacingAndGlyphs");
  }
}

// Plots drawn with this number of pixels for each of the page's, which Bokeh takes from the window.
// The glyphs of a legend are copied from the screen: they are painted before and afterwards, too.
function exported(plots, suffix, ratio) {
  const own = Object.getOwnPropertyDescriptor(window, "devicePixelRatio");
  const parts = plots.flatMap((plot) => [...plot.renderer_views.values()]);
  const paintLegends = () => parts.forEach((part) => part._paint_glyphs?.());
  Object.defineProperty(window, "devicePixelRatio", { value: ratio, configurable: true });
  try {
    paintLegends();
    return plots.map((plot) => plot.export(suffix));
  } finally {
    Object.defineProperty(window, "devicePixelRatio", own);
    paintLegends();
  }
}

// The picture of a card, with the heading and the colour scale that the page shows elsewhere.
async function pictureOf(card, { suffix, name, about, heading, scale }) {
  const { plots, clouds } = contentOf(card);
  const widths = [...plots.map(({ bbox }) => bbox.width), ...clouds.map((each) => each.clientWidth)];
  if (widths.length === 0) throw new Error("nothing is drawn here yet");
  const width = Math.max(...widths);
  const least = suffix === "png" ? PICTURE_PX / width : 1;
  const ratio = Math.max(window.devicePixelRatio, least);
  const layers = exported(plots, suffix, ratio);
  const parts = [
    ...layers.map(({ canvas, bbox: { width, height } }) => ({ canvas, width, height })),
    ...clouds.map((cloud) => cloud.picture(ratio)),
  ];
  const [above, below] = [heading ? HEADING_PX : 0, scale ? SCALE_PX : 0];
  const height = parts.reduce((sum, part) => sum + part.height, above + below);
  const { pen, blob } =
    suffix === "svg"
      ? svgSheet(layers[0].constructor, width, height, { title: name, desc: about })
      : canvasSheet(width, height, ratio);
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
    // Each rectangle extends below the next ones, so that no seam shows.
    pen.fillRect(MARGIN_PX + left, top + 6, length - left, 9);
  });
  pen.fillStyle = ink;
  const [line, right] = [top + 26, MARGIN_PX + length];
  write(pen, low, MARGIN_PX, line, "left", font, width);
  write(pen, high, right, line, "right", font, width);
  write(pen, title, width / 2, top + 38, "center", font, width);
}

// Add texts to a PNG (chunks iTXt, in UTF-8) behind its header.
function withText(png, texts) {
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

// CRC-32, as PNG requires it.
function checksum(bytes) {
  let sum = ~0;
  for (const byte of bytes) {
    sum ^= byte;
    for (let bit = 0; bit < 8; bit++) sum = (sum >>> 1) ^ (sum & 1 ? 0xedb88320 : 0);
  }
  return ~sum >>> 0;
}

function save(blob, name) {
  const link = element("a", "", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

// --------------------------------------------------------------------------------- button and menu

export function render({ model, view }) {
  const root = element("div", "", { class: "download" });
  const button = element("button", "", { type: "button", "aria-haspopup": "menu" });
  const menu = element("div", "", { role: "menu", popover: "auto" });
  const status = element("div", "", { class: "status", role: "status" });
  button.innerHTML = `<svg viewBox="0 0 24 24" aria-hidden="true"><path d="${ICON}"/></svg>`;
  root.append(element("style", STYLE), button, menu, status);
  let pieces = [];

  // While a file is prepared the button opens no menu; disabled it would lose the keyboard focus.
  const show = (isBusy, text) => {
    button.ariaBusy = String(isBusy);
    button.popoverTargetElement = isBusy ? null : menu;
    status.textContent = text;
    pieces = [];
  };
  const close = () => {
    menu.hidePopover();
    button.focus();
  };
  const entry = ([suffix, help]) => {
    const item = element("button", "", { type: "button", role: "menuitem", tabindex: "-1" });
    item.append(element("b", suffix.toUpperCase()), element("span", help));
    item.addEventListener("click", () => {
      close();
      show(true, `Preparing ${suffix.toUpperCase()} …`);
      model.send_msg({ suffix });
    });
    return item;
  };
  const list = () => {
    menu.replaceChildren(...model.formats.map(entry));
    button.title = button.ariaLabel = menu.ariaLabel = `Download: ${model.what}`;
  };
  model.on(["formats", "what"], list);
  list();
  show(false, "");

  menu.addEventListener("toggle", ({ newState }) => {
    const isOpen = newState === "open";
    button.ariaExpanded = String(isOpen);
    if (!isOpen) return;
    const [at, size] = [button.getBoundingClientRect(), menu.getBoundingClientRect()];
    const hasRoom = at.bottom + size.height + 4 < window.innerHeight;
    menu.style.left = `${Math.max(4, at.right - size.width)}px`;
    menu.style.top = `${hasRoom ? at.bottom + 2 : Math.max(4, at.top - size.height - 2)}px`;
    menu.firstChild.focus();
  });
  button.addEventListener("keydown", (event) => {
    if (event.key !== "ArrowDown" || button.popoverTargetElement === null) return;
    event.preventDefault();
    menu.showPopover();
  });
  menu.addEventListener("keydown", (event) => {
    const items = [...menu.children];
    const place = items.indexOf(menu.getRootNode().activeElement);
    const moves = { ArrowDown: place + 1, ArrowUp: place - 1, Home: 0, End: -1 };
    event.stopPropagation(); // arrow keys move pixels elsewhere
    if (event.key === "Tab" || event.key === "Escape") close();
    if (!(event.key in moves)) return;
    event.preventDefault();
    items.at(moves[event.key] % items.length).focus();
  });

  const receive = async ({ failed, picture, piece, size, name }) => {
    if (failed) {
      show(false, "");
    } else if (picture) {
      save(await pictureOf(view.parent, picture), picture.name);
      show(false, `Saved ${picture.name}`);
    } else {
      pieces.push(piece);
      const received = pieces.reduce((sum, each) => sum + each.byteLength, 0);
      if (received < size) return model.send_msg({ from: received });
      save(new Blob(pieces), name);
      show(false, `Saved ${name}`);
    }
  };
  model.on("msg:custom", (message) =>
    receive(message).catch((error) => {
      show(false, "");
      model.send_msg({ failed: error.message });
    }),
  );
  return root;
}
