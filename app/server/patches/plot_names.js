// Name plots for screen readers, and leave them out when the Tab key moves on.
//
// The layer of a plot that takes events has no name and no role, and is a tab stop although no key
// does anything there. Upstream: none found. Fixes: Compare has eight tab stops that say nothing.
{
  const plot = Bokeh.Models.get("Figure").prototype.default_view.prototype;
  const { after_render: rendered } = plot;
  plot.after_render = function () {
    rendered.call(this);
    const { model, canvas_view } = this;
    const layer = Object.assign(canvas_view.events_el, { role: "img", tabIndex: -1 });
    const describe = () => (layer.ariaLabel = model.title?.text || model.name || "Plot");
    describe();
    this.connect(model.properties.name.change, describe);
    if (model.title) this.connect(model.title.change, describe);
  };
}
