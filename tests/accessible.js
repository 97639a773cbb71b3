// What an accessibility checker looks for on any page, as a list of sentences; empty is good.
(() => {
  const found = [];
  const say = (what, element) => found.push(`${what}: ${element.outerHTML.slice(0, 160)}`);
  const all = (selector) => [...document.querySelectorAll(selector)];
  const named = (element) => {
    const label = element.getAttribute("aria-label");
    const by = (element.getAttribute("aria-labelledby") || "").split(" ").filter(Boolean);
    const texts = by.map((id) => document.getElementById(id)?.textContent || "");
    const images = [...element.querySelectorAll("img")].map((image) => image.alt);
    return (label || texts.join(" ") || element.textContent || images.join(" ")).trim();
  };

  if (document.documentElement.lang !== "en") found.push("no language");
  if (!document.title.trim()) found.push("no title");
  if (all("main").length !== 1) found.push("not one main");
  if (all("h1").length !== 1) found.push("not one h1");
  let level = 0;
  for (const heading of all("h1,h2,h3,h4,h5,h6")) {
    const mine = Number(heading.tagName[1]);
    if (mine > level + 1) say("heading skips a level", heading);
    if (!heading.textContent.trim()) say("empty heading", heading);
    level = mine;
  }
  const ids = all("[id]").map((element) => element.id);
  const known = new Set();
  for (const id of ids) {
    if (known.has(id)) found.push(`twice: ${id}`);
    known.add(id);
  }
  for (const element of all("[aria-labelledby],[aria-describedby]")) {
    const names = `${element.getAttribute("aria-labelledby") || ""} ${element.getAttribute("aria-describedby") || ""}`;
    for (const id of names.split(" ").filter(Boolean)) if (!document.getElementById(id)) say(`no ${id}`, element);
  }
  for (const head of all("th")) if (!head.scope) say("th without scope", head);
  for (const table of all("table")) {
    const widths = [...table.rows].map((row) => [...row.cells].reduce((sum, cell) => sum + cell.colSpan, 0));
    if (new Set(widths).size > 1) say("rows of several lengths", table);
  }
  for (const image of all("img")) if (!image.hasAttribute("alt")) say("img without alt", image);
  for (const svg of all("svg:not([aria-hidden=true])")) {
    if (!["img", "group"].includes(svg.getAttribute("role")) || !named(svg)) say("svg without a name", svg);
  }
  for (const link of all("a[href],button,summary")) if (!named(link)) say("nothing says what it does", link);
  for (const field of all("input:not([type=hidden]),select,textarea")) {
    const labels = [...field.labels].map((label) => label.textContent).join(" ");
    if (!(labels.trim() || named(field) && field.hasAttribute("aria-label"))) say("field without a label", field);
  }
  for (const region of all("[role=region],nav")) if (!named(region)) say("region without a name", region);
  for (const box of all("*")) {
    const style = getComputedStyle(box);
    const scrolls = ["auto", "scroll"].includes(style.overflowX) && box.scrollWidth > box.clientWidth + 1;
    if (scrolls && box.tabIndex < 0) say("scrolls but not by keyboard", box);
  }

  // Contrast as WCAG 2.2 defines it, of every visible text against what lies behind it.
  const parts = (colour) => {
    const numbers = colour.match(/[\d.]+/g).map(Number);
    return numbers.length === 3 ? [...numbers, 1] : numbers;
  };
  const over = (front, back) => front.slice(0, 3).map((v, i) => v * front[3] + back[i] * (1 - front[3]));
  const luminance = (rgb) => {
    const [r, g, b] = rgb.map((v) => v / 255).map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const backs = new Map();
  const behind = (element) => {
    if (!element) return [255, 255, 255];
    if (!backs.has(element)) {
      const colour = parts(getComputedStyle(element).backgroundColor);
      backs.set(element, colour[3] === 1 ? colour.slice(0, 3) : over(colour, behind(element.parentElement)));
    }
    return backs.get(element);
  };
  let texts = 0;
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const element = walker.currentNode.parentElement;
    if (!walker.currentNode.textContent.trim() || !element.getClientRects().length) continue;
    if (element.closest("desc,title,style,.unseen")) continue;
    const style = getComputedStyle(element);
    const back = behind(element);
    const ink = parts(element instanceof SVGElement ? style.fill : style.color);
    for (let each = element; each; each = each.parentElement) ink[3] *= Number(getComputedStyle(each).opacity);
    const [a, b] = [luminance(over(ink, back)), luminance(back)];
    const contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    texts += 1;
    if (contrast < 4.5) say(`contrast ${contrast.toFixed(2)}`, element);
  }
  if (!texts) found.push("no text was looked at");
  return found;
})();
