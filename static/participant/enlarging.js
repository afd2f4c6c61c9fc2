// One clip of a pair at a time, as large as the page allows, for small screens. Both go on playing together, so that
// changing from one to the other compares the same moment. Without this both are shown.

export class Enlarging {
  constructor(page) {
    this.page = page;
    this.figures = [...page.querySelectorAll("figure[data-side]")];
    for (const figure of this.figures) {
      const button = figure.querySelector("[data-enlarge]");
      const other = this.figures.find((each) => each !== figure);
      button.addEventListener("click", () => this.#toggle(figure));
      figure.querySelector("[data-other]").addEventListener("click", () => this.show(other));
      figure.addEventListener("click", (event) => {
        if (event.target.matches("video") && button.checkVisibility?.()) this.#toggle(figure);
      });
      figure.querySelector("[data-enlarging]").hidden = false;
    }
    addEventListener("keydown", (event) => {
      if (event.key === "Escape" && this.shown && !page.querySelector("dialog[open]")) this.show(null);
    });
  }

  // This one alone, or both.
  show(figure) {
    const from = document.activeElement;
    this.shown = figure;
    this.page.toggleAttribute("data-enlarged", Boolean(figure));
    for (const each of this.figures) {
      each.toggleAttribute("data-alone", each === figure);
      each.inert = Boolean(figure) && each !== figure;
      each.querySelector("[data-enlarge]").setAttribute("aria-pressed", String(each === figure));
    }
    if (figure && from?.closest("figure") && from.closest("figure") !== figure) {
      figure.querySelector("[data-other]").focus({ preventScroll: true });
    }
  }

  #toggle(figure) {
    this.show(this.shown === figure ? null : figure);
  }
}
