// The cameras' tiles: a button each, painted as pictures come; what was painted is told to the server.

import { nextFrame, paint, picture } from "./live.js";
import { awaySince, byId, element, number } from "./words.js";

const GONE_S = 2;
const painted = new MessageChannel();
const waiting = [];
painted.port1.onmessage = () => waiting.shift()?.();

export class Tiles {
  #tiles = new Map();
  #live;
  #open;
  onFull = () => {};

  constructor(live, open) {
    this.#live = live;
    this.#open = open;
    live.addEventListener("tiles", (event) => this.#paint(event.detail));
  }

  get ids() {
    return [...this.#tiles.keys()];
  }

  show(state) {
    const ids = state.cameras.map((camera) => camera.id);
    if (ids.join() !== this.ids.join()) this.#make(state.cameras);
    byId("no-cameras").hidden = ids.length > 0;
    for (const camera of state.cameras) {
      const tile = this.#tiles.get(camera.id);
      const gone = isGone(camera);
      tile.button.classList.toggle("gone", gone);
      tile.button.classList.toggle("moved", camera.moved !== null);
      tile.away.hidden = !gone;
      tile.away.textContent = gone ? awaySince(camera.away_s) : "";
      const rate = state.health.fps?.[camera.id];
      tile.rate.textContent = gone || rate === undefined || rate === null ? "" : number(rate, 0);
      const state_ = gone ? awaySince(camera.away_s) : camera.moved ?? "delivers";
      tile.button.setAttribute("aria-label", `${camera.name}, ${state_}; enlarge`);
      tile.name.textContent = camera.name;
    }
  }

  // Move the focus from tile to tile.
  step(columns, rows) {
    const buttons = [...this.#tiles.values()].map((tile) => tile.button);
    if (!buttons.length) return;
    const across = getComputedStyle(byId("tiles")).gridTemplateColumns.split(" ").length;
    const at = buttons.indexOf(document.activeElement);
    const next = at < 0 ? 0 : at + columns + rows * across;
    buttons[Math.min(Math.max(next, 0), buttons.length - 1)].focus();
  }

  focused() {
    return this.ids.find((id) => this.#tiles.get(id).button === document.activeElement);
  }

  #make(cameras) {
    this.#tiles.clear();
    const grid = byId("tiles");
    grid.style.setProperty("--across", across(cameras.length));
    grid.querySelectorAll(".tile").forEach((old) => old.remove());
    for (const camera of cameras) {
      const button = element("button", "", "tile");
      const tile = {
        button,
        canvas: element("canvas"),
        name: element("span", camera.name, "name"),
        rate: element("span", "", "rate"),
        away: element("span", "", "away"),
      };
      [tile.canvas.width, tile.canvas.height] = [240, 320];
      button.append(tile.canvas, tile.name, tile.rate, tile.away);
      button.addEventListener("click", () => this.#open(camera.id));
      this.#tiles.set(camera.id, tile);
      grid.append(button);
    }
  }

  async #paint(message) {
    let start = message.start;
    const decoding = message.tiles.map((tile) => {
      const found = picture(message.data, start, tile.bytes).then((bitmap) => ({ tile, bitmap }));
      start += tile.bytes;
      return found;
    });
    const pictures = (await Promise.allSettled(decoding)).filter((one) => one.value).map((one) => one.value);
    await nextFrame();
    for (const { tile, bitmap } of pictures) {
      const target = this.#tiles.get(tile.camera);
      if (target) paint(target.canvas, bitmap);
      if (tile.full) this.onFull(tile.camera, bitmap);
      bitmap.close();
    }
    // The browser has painted by the time that a message posted here comes back.
    waiting.push(() => this.#live.painted(message.number));
    painted.port2.postMessage(0);
  }
}

// Columns of a wide page, so that the last row is as full as can be.
function across(count) {
  return count <= 5 ? Math.max(count, 3) : Math.ceil(count / 2) <= 6 ? Math.ceil(count / 2) : 8;
}

export function isGone(camera) {
  return !camera.connected || camera.away_s === null || camera.away_s > GONE_S;
}
