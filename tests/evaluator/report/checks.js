// What a report needs beyond what any page does (accessible.js), as a list of sentences.
(() => {
  const found = [];
  const say = (what, element) => found.push(`${what}: ${element.outerHTML.slice(0, 160)}`);
  const all = (selector) => [...document.querySelectorAll(selector)];
  const named = (element) => element.getAttribute("aria-label") || element.getAttribute("aria-labelledby");

  for (const table of all("table")) {
    if (!table.caption?.textContent.trim()) say("table without caption", table);
    const width = table.tHead.rows[0].cells.length;
    for (const row of table.tBodies[0].rows) if (row.cells.length !== width) say("row of another length", row);
  }
  for (const image of all("img")) if (!image.alt.trim()) say("img without alt", image);
  for (const svg of all("svg")) if (svg.getAttribute("role") !== "img") say("svg that is no image", svg);
  for (const figure of all("figure")) {
    if (!figure.querySelector("figcaption")) say("figure without caption", figure);
    const drawn = figure.querySelector("svg");
    if (drawn && !/[0-9]/.test(drawn.querySelector("desc")?.textContent ?? "")) say("figure without its values in words", figure);
  }
  for (const link of all("a")) {
    if (!link.textContent.trim()) say("link without text", link);
    if (!document.getElementById(link.getAttribute("href").slice(1))) say("link to nowhere", link);
  }
  for (const section of all("section")) if (!named(section) && !section.textContent.trim()) say("empty section", section);
  const texts = all("body *").filter((element) => [...element.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim()));
  if (texts.length < 50) found.push(`only ${texts.length} texts were looked at`);
  return found;
})();
