// Change the colours of the page and of all its components together with its mode.
//
// A page of panel-material-ui takes the colours of the other mode only after it has been drawn in
// that mode, and until then shows light text on light paper. Its components, each with a palette of
// its own, follow one by one. Upstream: none found. Gain: avoids an unreadable page while it draws
// (0.2 s, 5 s on a busy machine), and unreadable labels for up to ten times that.
{
  const palette = new CSSStyleSheet();

  // From the first change of the mode on, components inherit the colours of the page.
  const inheritPalette = () => {
    const page = document.querySelector("#page-style");
    const names = new Set(page?.textContent.match(/--mui-palette-[\w-]+(?=:)/g));
    const rules = [...names].map((name) => `${name}: inherit !important;`);
    palette.replaceSync(`:host { ${rules.join(" ")} }`);
  };

  const view = Bokeh.Models.get("panel.models.esm.ReactComponent").prototype.default_view.prototype;
  const { connect_signals: connect, render } = view;
  view.connect_signals = function () {
    connect.call(this);
    const { data } = this.model;
    const colors = data?.theme_config;
    if (!colors?.light || !colors?.dark) return;
    this.connect(data.properties.dark_theme.change, () => {
      inheritPalette();
      const theme_config = colors[data.dark_theme ? "dark" : "light"];
      data.setv({ theme_config }, { sync: false });
    });
  };
  view.render = function () {
    render.call(this);
    // Those of the header have other colours.
    if (!this.parent?.model.data?.header?.includes(this.model)) {
      this.shadow_el.adoptedStyleSheets = [palette];
    }
  };
}
