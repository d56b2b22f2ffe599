// Open a page in a narrow window with the sidebar closed.
//
// Panel's template opens its sidebar on top of the page, which it covers until everything is drawn.
// Upstream: none found. Fixes: the page is covered on a phone.
{
  // Width below which the sidebar covers the page.
  const NARROW_PX = 900;

  const view = Bokeh.Models.get("panel.models.esm.ReactComponent").prototype.default_view.prototype;
  const { initialize } = view;
  view.initialize = function () {
    const { data } = this.model;
    if ("is_narrow" in data.attributes && window.innerWidth < NARROW_PX)
      data.setv({ sidebar_open: false, is_narrow: true });
    initialize.call(this);
  };
}
