// Rebuild the items of a legend only where they have changed.
//
// A legend rebuilds its items whenever anything below them changes, such as the data of a line; the
// browser then lays out the page in the middle of a paint. Upstream: none found.
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
    const wanted = JSON.stringify(items);
    if (wanted === this.built) return;
    this.built = wanted;
    build.call(this);
  };
}
