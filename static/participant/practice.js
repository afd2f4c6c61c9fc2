// The strip on a practice page: ticks off what the person has tried, by key or by button.

export class Practice {
  constructor(root, say, done) {
    this.keys = new Map([...root.querySelectorAll("[data-practice-key]")].map((each) => [each.dataset.practiceKey, each]));
    this.say = say;
    this.done = done;
    this.allUsed = root.dataset.sayAllUsed;
  }

  used(name) {
    const item = this.keys.get(name);
    if (!item || item.hasAttribute("data-used")) return;
    item.setAttribute("data-used", "");
    const all = [...this.keys.values()].every((each) => each.hasAttribute("data-used"));
    this.say(all ? this.allUsed : item.dataset.usedLabel);
    if (all) this.done(this.keys.size);
  }
}
