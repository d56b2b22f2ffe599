// Keep the sidebar closed in a narrow window.
//
// Panel's template opens its sidebar on top of the page, which it covers.
// Upstream: none found. Fixes: the page is covered on a phone.
{
  // Width below which the sidebar covers the page.
  const NARROW_PX = 900;

  const view = Bokeh.Models.get("panel.models.esm.ReactComponent").prototype.default_view.prototype;
  const { initialize } = view;
  view.initialize = function () {
    const { data } = this.model;
    if ("is_narrow" in data.attributes) {
      const narrow = matchMedia(`(width < ${NARROW_PX}px)`);
      if (narrow.matches) data.setv({ sidebar_open: false, is_narrow: true });
      narrow.addEventListener("change", ({ matches }) => data.setv({ is_narrow: matches }));
    }
    initialize.call(this);
  };
}
