// Name the button that folds a card after the card, and fold by the title, too.
//
// Panel names the button of every card "show more", and its title does nothing. Upstream: none found.
// Fixes: screen readers do not announce which part is folded.
{
  const view = Bokeh.Models.get("panel.models.esm.ReactComponent").prototype.default_view.prototype;
  const { after_rendered: rendered } = view;
  view.after_rendered = function () {
    rendered.call(this);
    const header = this.shadow_el.querySelector(".MuiCardHeader-root");
    const button = header?.querySelector("[aria-expanded]");
    if (!button) return;
    button.ariaLabel = header.textContent;
    header.style.cursor = "pointer";
    header.onclick = ({ target }) => button.contains(target) || button.click();
  };
}
