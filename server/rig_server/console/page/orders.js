// What a person has the rig do, and the sentence about how it went.

import { byId, element } from "./words.js";

const SHOWN_MS = 7000;
const MOST = 4;

export async function order(action, wanted = {}) {
  let answer;
  try {
    const response = await fetch(`/do/${action}`, {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(wanted),
    });
    answer = response.headers.get("Content-Type")?.startsWith("application/json")
      ? await response.json()
      : { ok: false, text: await response.text() };
  } catch {
    answer = { ok: false, text: "The server does not answer." };
  }
  say(answer.text, !answer.ok);
  return answer.ok;
}

export function say(text, bad = false) {
  const shown = byId("said");
  const line = element("li", text.charAt(0).toUpperCase() + text.slice(1), bad ? "bad" : "");
  shown.append(line);
  while (shown.children.length > MOST) shown.firstChild.remove();
  setTimeout(() => line.remove(), SHOWN_MS);
}

// Run while a button rests, so that nobody presses it twice.
export function onPress(id, work) {
  const button = byId(id);
  button.addEventListener("click", async () => {
    if (button.disabled) return;
    button.disabled = true;
    try {
      await work();
    } finally {
      button.disabled = false;
    }
  });
}
