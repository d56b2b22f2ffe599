// Paint plots again after the browser has lost its graphics context.
//
// A browser may empty all canvases, as when a laptop wakes up, those of images and colour bars
// included, and restores them one after the other. Bokeh does not repaint. Upstream: none found.
// Fixes empty plots.
{
  // Time within which a browser that restores one canvas has restored all.
  const RESTORED_MS = 200;

  const { ColorMapper } = Bokeh.require("models/mappers/color_mapper");
  const canvas = Bokeh.Models.get("Canvas").prototype.default_view.prototype;
  const { initialize } = canvas;

  const paintAgain = (plot) => {
    for (const model of plot.model.references())
      if (model instanceof ColorMapper) model.change.emit();
    plot.request_repaint();
  };
  canvas.initialize = function () {
    initialize.call(this);
    this.primary.canvas.addEventListener("contextrestored", () =>
      setTimeout(() => this.plot_views.forEach(paintAgain), RESTORED_MS),
    );
  };
}
