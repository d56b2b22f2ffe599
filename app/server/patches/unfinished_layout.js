// Leave plots that have no layout yet out of a layout of the page.
//
// Each part that is resized makes Bokeh lay out the whole page, including plots that have just been
// built and are laid out next. Upstream: none found. Fixes: errors in the console, up to 33 when pages
// and theme are changed quickly; each leaves the rest of the page as it was.
{
  const plot = Bokeh.Models.get("Figure").prototype.default_view.prototype;
  for (const name of ["_measure_layout", "_after_layout"]) {
    const { [name]: original } = plot;
    plot[name] = function () {
      if (this.layout) original.call(this);
    };
  }

  // A change of the theme makes a colour bar request a layout, likewise.
  const bar = Bokeh.Models.get("ColorBar").prototype.default_view.prototype;
  const { lazy_initialize: build } = bar;
  bar.lazy_initialize = async function () {
    await build.call(this);
    const { parent } = this._axis_view;
    const { request_layout: request } = parent;
    parent.request_layout = () => this.layout && request.call(parent);
  };
}
