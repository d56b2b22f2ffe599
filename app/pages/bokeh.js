// Where Bokeh does more in a browser than this app needs. It runs once Bokeh is loaded, before
// anything is drawn.

// A change is sent once the server has answered the last one, or has taken this long.
const LONGEST_PAUSE_MS = 250;

// By then a widget has drawn what the server said.
const DRAWN_MS = 500;

// By then a browser that gives back one canvas has given back all.
const RESTORED_MS = 200;

// The server refuses a page's connection by this code if the page's session has ended (RFC 6455).
const SESSION_ENDED = 1008;

// A page less wide begins without its sidebar, which would cover what it controls.
const NARROW_PX = 900;

{
  // A plot writes the style sheet of each of its parts at every stroke, mostly as it was. For the
  // browser it is another one each time, and all that hangs on it has to be looked up again.
  const sheet = Bokeh.require("core/dom").InlineStyleSheet.prototype;
  const write = sheet._update;
  sheet._update = function (css) {
    if (css !== this.css) write.call(this, css);
  };

  // Each line and each text asks the page for a style of its own, which none has here.
  Bokeh.require("core/visuals/visual").VisualProperties.prototype._get_css_value = () => "";
}

{
  // A legend builds its items anew whenever anything below them changes, such as the data of a line.
  // The browser then lays out the page, in the middle of a stroke.
  const legend = Bokeh.Models.get("Legend").prototype.default_view.prototype;
  const { render, _render_items: build } = legend;
  legend.render = function () {
    this.built = undefined;
    render.call(this);
  };
  legend._render_items = function () {
    const items = this.model.items.map((item) => [
      item.id,
      item.get_labels_list_from_label_prop(),
      item.visible,
      item.renderers.map(({ visible }) => visible),
    ]);
    const wanted = JSON.stringify(items);
    if (wanted === this.built) return;
    this.built = wanted;
    build.call(this);
  };
}

{
  // While a page is being built, Bokeh may measure plots of it that have no layout yet, and fail.
  const view = Bokeh.Models.get("Figure").prototype.default_view.prototype;
  for (const name of ["_measure_layout", "_after_layout"]) {
    const act = view[name];
    view[name] = function () {
      if (this.layout) act.call(this);
    };
  }
}

// Panel's widgets tell their model what they show each time that they have been drawn. If the server
// has said something else by then, they would undo it: what it said before that is not taken.
const keepNewest = (data) => {
  const { setv: set } = data;
  let said = {};
  let pause;
  data.setv = function (values, options) {
    let taken = Object.entries(values);
    if (options?.sync === false) {
      for (const [name, value] of taken) (said[name] ??= []).push(value);
      clearTimeout(pause);
      pause = setTimeout(() => (said = {}), DRAWN_MS);
    } else {
      taken = taken.filter(
        ([name, value]) => !said[name]?.includes(value) || value === said[name].at(-1),
      );
    }
    return set.call(this, Object.fromEntries(taken), options);
  };
};

{
  const widget = Bokeh.Models.get("panel.models.esm.ReactComponent").prototype;
  const { initialize: begin } = widget;
  widget.initialize = function () {
    begin.call(this);
    keepNewest(this.data);
  };

  const view = widget.default_view.prototype;
  const { after_rendered: rendered, initialize } = view;
  view.initialize = function () {
    const { data } = this.model;
    if ("is_narrow" in data.attributes && window.innerWidth < NARROW_PX)
      data.setv({ sidebar_open: false, is_narrow: true });
    initialize.call(this);
  };

  // A part that folds is called "show more", whatever it is, and its title does nothing.
  view.after_rendered = function () {
    rendered.call(this);
    const header = this.shadow_el.querySelector(".MuiCardHeader-root");
    const button = header?.querySelector("[aria-expanded]");
    if (!button) return;
    button.ariaLabel = header.textContent;
    header.style.cursor = "pointer";
    header.onclick = ({ target }) => button.contains(target) || button.click();
  };
}

{
  // A hand moves a slider sixty times a second, whether or not the server is done with the last
  // value. Of those that it overtakes in the meantime none is sent.
  const { DocumentEventBatch } = Bokeh.require("document/events");
  const session = Bokeh.require("client/session").ClientSession.prototype;
  const send = session._document_changed;
  const take = session._handle_patch;

  const sendWaiting = (session) => {
    const events = [...session.waiting.values()];
    session.waiting.clear();
    clearTimeout(session.pause);
    session.pause = setTimeout(() => goOn(session), LONGEST_PAUSE_MS);
    send.call(session, new DocumentEventBatch(session.document, events));
  };
  const goOn = (session) => {
    clearTimeout(session.pause);
    session.pause = undefined;
    if (session.waiting?.size) sendWaiting(session);
  };

  session._document_changed = function (event) {
    if (!event.sync) return;
    this.waiting ??= new Map();
    let isUrgent = this.pause === undefined;
    for (const each of (event.events ?? [event]).filter((each) => each.sync)) {
      // Each change of the page's theme gives it one more style, which the server has no use for.
      if (each.model?.type === "Toolbar") continue;
      // A click or the like may ask for what was set before it: all of it is sent, in order.
      isUrgent ||= each.kind !== "ModelChanged";
      const what = each.kind === "ModelChanged" ? `${each.model.id} ${each.attr}` : each;
      this.waiting.delete(what);
      this.waiting.set(what, each);
    }
    if (isUrgent && this.waiting.size) sendWaiting(this);
  };
  session._handle_patch = function (message) {
    take.call(this, message);
    goOn(this);
  };
}

{
  // A session ends if its page takes long to connect, on a very slow line for example. The page then
  // has nothing to show: load it again.
  const connection = Bokeh.require("client/connection").ClientConnection.prototype;
  const { connect } = connection;
  connection.connect = function () {
    const connected = connect.call(this);
    connected.catch(({ message }) => {
      if (message.includes(` ${SESSION_ENDED} `)) location.reload();
    });
    return connected;
  };
}

{
  // A browser that loses its graphics, as when a laptop wakes up, empties every canvas, those of
  // images and colour bars among them, and gives them back one after the other.
  const { ColorMapper } = Bokeh.require("models/mappers/color_mapper");
  const canvas = Bokeh.Models.get("Canvas").prototype.default_view.prototype;
  const { initialize } = canvas;

  const paintAnew = (plot) => {
    for (const model of plot.model.references())
      if (model instanceof ColorMapper) model.change.emit();
    plot.request_repaint();
  };
  canvas.initialize = function () {
    initialize.call(this);
    this.primary.canvas.addEventListener("contextrestored", () =>
      setTimeout(() => this.plot_views.forEach(paintAnew), RESTORED_MS),
    );
  };
}

{
  const layer = Bokeh.Models.get("GlyphRenderer").prototype.default_view.prototype;

  // Of each layer Bokeh keeps four more pictures: how it would look if it were chosen, or others
  // were. Those that nobody asked for, which it makes itself and which are in no document, are the
  // layer's own picture: nothing is ever chosen in a plot.
  const { build_glyph_view: build } = layer;
  const kept = ["set_data", "set_visuals", "after_visuals", "after_lazy_visuals", "map_data"];
  const own = Object.fromEntries([...kept, "remove"].map((name) => [name, { value() {} }]));
  layer.build_glyph_view = async function (glyph) {
    if (!glyph.document) return Object.create(this.glyph, own);
    const view = await build.call(this, glyph);
    view._mask_data = undefined; // to look for what lies outside the window costs more than it saves
    return view;
  };

  // A layer above the others, which is painted without them, reached out of the window else.
  Object.defineProperty(layer, "needs_clip", { value: true });

  // On the page nothing stands where a layer is.
  layer.update_position = function () {
    this.position.replace(":host { display: none; }");
  };
}

{
  // What the server changes is painted as soon as all plots have taken it in. Bokeh would wait for
  // the next frame to begin, and what it then paints would be shown no earlier.
  const session = Bokeh.require("client/session").ClientSession.prototype;
  const layer = Bokeh.Models.get("GlyphRenderer").prototype.default_view.prototype;
  const plot = Bokeh.Models.get("Figure").prototype.default_view.prototype;
  const { _handle_patch: take } = session;
  const { update_data: update } = layer;
  const { schedule_paint: schedule } = plot;
  let updates, outdated; // while messages are being taken in

  const paint = () => {
    const plots = outdated ?? [];
    updates = outdated = undefined;
    for (const plot of plots) queueMicrotask(() => plot.is_destroyed || plot.repaint());
  };
  session._handle_patch = function (message) {
    updates ??= [];
    outdated ??= new Set();
    try {
      take.call(this, message);
    } finally {
      Promise.allSettled(updates).then(paint);
    }
  };
  layer.update_data = function (indices) {
    const updated = update.call(this, indices);
    updates?.push(updated);
    return updated;
  };
  plot.schedule_paint = function () {
    if (outdated && !this.is_paused) outdated.add(this);
    else schedule.call(this);
  };
}
