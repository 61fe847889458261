// The keyboard: one table for what keys do and for the help that shows them.

import { byId, element } from "./words.js";

export class Keys {
  #keys;

  // `keys`: [label, what it does, matches(event) -> boolean, run(event)]
  constructor(keys) {
    this.#keys = keys;
    for (const [label, meaning] of keys) {
      const row = element("tr");
      const cell = element("td");
      for (const part of label.split(" ")) cell.append(element("kbd", part), " ");
      row.append(cell, element("td", meaning));
      byId("keys").append(row);
    }
    byId("help").querySelector(".close").addEventListener("click", () => byId("help").close());
    document.addEventListener("keydown", (event) => this.#press(event));
  }

  #press(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
    if (event.target.closest("input[type=text], select, textarea")) return;
    if (byId("help").open && event.key !== "?") return;
    for (const [, , matches, run] of this.#keys) {
      if (matches(event)) {
        event.preventDefault();
        run(event);
        return;
      }
    }
  }
}
