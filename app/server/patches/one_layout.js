// Lay out the page once for all parts of a message, and not for a component without parts.
//
// Each property that can change a size makes Bokeh lay out the whole page at once, so that a change of
// page or subject, which shows and hides some ten parts, does so ten times. Panel takes each component
// whose size is reported for changed: what another page shows again is reported component by
// component, some fifty times. The browser sizes components itself, and plots report their own sizes.
// Upstream: none found. Gain: going to another page takes 0.5 instead of 1.5 s of the main thread
// (`tests.patches`), showing another part of Inspect 0.3 instead of 0.8 s.
{
  const components = Bokeh.Models.get("panel.models.esm.ReactiveESM").prototype.default_view.prototype;
  const { LayoutDOMView } = Bokeh.require("models/layouts/layout_dom");

  const asked = new Set();
  for (const views of [LayoutDOMView.prototype, components]) {
    const { invalidate_layout: layOut } = views;
    views.invalidate_layout = function () {
      // The first layout must be there when the page is said to be complete.
      if (this.is_managed || !this._layout_computed) return layOut.call(this);
      if (asked.has(this)) return;
      asked.add(this);
      queueMicrotask(() => {
        asked.delete(this);
        if (!this.is_destroyed) layOut.call(this);
      });
    };
  }

  // A parent measures its plots when it is resized itself; a plot that a text below makes smaller then
  // takes its size for known, and stays painted in the former one.
  const plots = Bokeh.Models.get("Figure").prototype.default_view.prototype;
  const { after_resize: resize } = plots;
  plots.after_resize = function () {
    resize.call(this);
    if (!this.layout || this.bbox.is_empty) return;
    const { width, height } = this.canvas.bbox;
    if (width !== this.bbox.width || height !== this.bbox.height) this.invalidate_layout();
  };

  const { _after_resize: layOut } = components;
  components._after_resize = function () {
    if (this.child_views.length > 0) layOut.call(this);
  };
}
