// Change the page's colours together with its mode.
//
// A page of panel-material-ui takes the colours of the other mode only after it has been drawn in
// that mode, and until then shows light text on light paper. Upstream: none found. Gain: avoids an
// unreadable page while it draws (0.2 s, 5 s on a busy machine).
{
  const view = Bokeh.Models.get("panel.models.esm.ReactComponent").prototype.default_view.prototype;
  const { connect_signals: connect } = view;
  view.connect_signals = function () {
    connect.call(this);
    const { data } = this.model;
    const colors = data?.theme_config;
    if (!colors?.light || !colors?.dark) return;
    this.connect(data.properties.dark_theme.change, () => {
      const theme_config = colors[data.dark_theme ? "dark" : "light"];
      data.setv({ theme_config }, { sync: false });
    });
  };
}
