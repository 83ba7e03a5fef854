"use strict";
// Tooltips, choices, and, where the page is live, its renewal. Text from the server is HTML that the server has escaped.
(() => {
  const tip = document.createElement("div");
  tip.id = "tip";
  tip.hidden = true;
  document.body.append(tip);
  const point = (event) => {
    const text = event.target.getAttribute && event.target.getAttribute("data-tip");
    tip.hidden = !text;
    if (!text) return;
    tip.textContent = text;
    const { width, height } = tip.getBoundingClientRect();
    const left = Math.min(event.clientX + 14, innerWidth - width - 8);
    const top = event.clientY - height - 14;
    tip.style.left = `${Math.max(8, left)}px`;
    tip.style.top = `${top < 8 ? event.clientY + 18 : top}px`;
  };
  addEventListener("pointermove", point);
  addEventListener("pointerdown", point);
  addEventListener("scroll", () => { tip.hidden = true; }, { passive: true });

  const kept = new Map(); // what the reader chose or opened survives a renewal
  const choose = (select) => {
    for (const option of select.options) {
      const part = document.getElementById(option.value);
      if (part) part.hidden = option.value !== select.value;
    }
  };
  addEventListener("change", (event) => {
    if (event.target.matches("select[data-choice]")) {
      kept.set(event.target.id, event.target.value);
      choose(event.target);
    }
  });
  addEventListener("toggle", (event) => {
    if (event.target.dataset && event.target.dataset.keep) kept.set(event.target.dataset.keep, event.target.open);
  }, true);
  const restore = (part) => {
    for (const select of part.querySelectorAll("select[data-choice]")) {
      const wanted = kept.get(select.id);
      if (wanted && [...select.options].some((option) => option.value === wanted)) select.value = wanted;
      choose(select);
    }
    for (const details of part.querySelectorAll("details[data-keep]")) details.open = kept.get(details.dataset.keep) === true;
  };

  const source = document.body.dataset.live;
  if (!source) return;
  const every = 2000;
  const last = new Map();
  let version = "";
  const renew = (parts) => {
    const root = document.getElementById("sections");
    let before = null;
    for (const [id, text] of parts) {
      let part = document.getElementById(id);
      const isFilm = id === "film" && part && text.includes(`data-version="${part.dataset.version}"`);
      if (last.get(id) !== text && !isFilm) {
        const fresh = document.createElement("template");
        fresh.innerHTML = text;
        const element = fresh.content.firstElementChild;
        if (part) part.replaceWith(element);
        else if (before) before.after(element);
        else root.prepend(element);
        part = element;
        restore(part);
        if (id === "film") document.dispatchEvent(new Event("film"));
      }
      last.set(id, text);
      if (id !== "head") before = part;
    }
    for (const part of [...root.children]) if (!parts.some(([id]) => id === part.id)) part.remove();
  };
  const look = async () => {
    const lost = document.getElementById("lost");
    try {
      const answer = await fetch(`${source}?known=${encodeURIComponent(version)}`, { cache: "no-store", signal: AbortSignal.timeout(10000) });
      if (answer.status === 200) {
        const news = await answer.json();
        renew(news.parts);
        version = news.version;
        document.documentElement.dataset.version = version;
      } else if (answer.status !== 204) throw new Error(String(answer.status));
      lost.hidden = true;
    } catch {
      lost.hidden = false;
    }
    setTimeout(() => (document.hidden ? document.addEventListener("visibilitychange", look, { once: true }) : look()), every);
  };
  look();
})();
