// Paint a change as soon as all plots have received it, each plot once.
//
// Bokeh waits for the next animation frame to start, and what it then paints is shown no earlier.
// Upstream: none found. Gain: plots are painted 14 instead of 20 to 29 ms after their data arrive
// (`tests.latency`, three pages in turn); CPU time is the same.
{
  const session = Bokeh.require("client/session").ClientSession.prototype;
  const layer = Bokeh.Models.get("GlyphRenderer").prototype.default_view.prototype;
  const plot = Bokeh.Models.get("Figure").prototype.default_view.prototype;
  const axis = Bokeh.require("models/axes/axis").AxisView.prototype;
  const { _handle_patch: take } = session;
  const { update_data: update } = layer;
  const { schedule_paint: schedule } = plot;
  const { _init_axis_label: label } = axis;
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
  axis._init_axis_label = function () {
    const labelled = label.call(this);
    updates?.push(labelled);
    return labelled;
  };
  plot.schedule_paint = function () {
    if (outdated && !this.is_paused) outdated.add(this);
    else schedule.call(this);
  };
}
