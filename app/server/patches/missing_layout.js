// Ignore plots without a layout.
//
// While a page is being built, Bokeh may measure plots that have no layout yet, and fails. Upstream:
// none found. Fixes errors in the console.
{
  const view = Bokeh.Models.get("Figure").prototype.default_view.prototype;
  for (const name of ["_measure_layout", "_after_layout"]) {
    const act = view[name];
    view[name] = function () {
      if (this.layout) act.call(this);
    };
  }
}
