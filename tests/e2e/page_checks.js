// What everybody needs of a page, checked on what is shown: names, headings, identifiers, contrast (WCAG 2.2, 1.4.3, 4.1.2).
const shown = (node) => node.checkVisibility({ checkVisibilityCSS: true }) && !node.closest("[aria-hidden=true]") && !node.closest(".skip");
const light = (colour) => {
  const parts = colour.match(/[\d.]+/g).map(Number).slice(0, 3).map((part) => part / 255).map((part) => part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4);
  return 0.2126 * parts[0] + 0.7152 * parts[1] + 0.0722 * parts[2];
};
const ground = (node) => {
  for (let one = node; one; one = one.parentElement) {
    const colour = getComputedStyle(one).backgroundColor;
    if (!/, 0\)$|transparent/.test(colour)) return colour;
  }
  return "rgb(255, 255, 255)";
};
const nameOf = (node) => (node.getAttribute("aria-label") || [...(node.labels || [])].map((one) => one.textContent).join(" ") || node.textContent || node.title || "").trim();
window.mistakes = () => {
  const found = [], ids = new Map();
  for (const node of document.body.querySelectorAll("*")) {
    if (node.id) ids.set(node.id, (ids.get(node.id) || 0) + 1);
    if (!shown(node)) continue;
    if (/^(BUTTON|A|INPUT|SELECT|TEXTAREA|DIALOG|NAV)$/.test(node.tagName) || ["treeitem", "tree", "img", "region", "group"].includes(node.getAttribute("role")))
      if (!nameOf(node) && !node.getAttribute("aria-labelledby") && !(node.getAttribute("role") === "group" && node.tagName === "UL")) found.push(`${node.tagName} has no name: ${node.outerHTML.slice(0, 120)}`);
    if (node.tabIndex > 0) found.push(`a tab index above 0: ${node.outerHTML.slice(0, 120)}`);
    const own = [...node.childNodes].filter((one) => one.nodeType === 3).map((one) => one.textContent).join("").trim();
    if (!own) continue;
    const [dark, pale] = [light(getComputedStyle(node).color), light(ground(node))].sort((a, b) => a - b);
    const ratio = (pale + 0.05) / (dark + 0.05);
    if (ratio < 4.5) found.push(`contrast ${ratio.toFixed(2)} of "${own.slice(0, 40)}": ${getComputedStyle(node).color} on ${ground(node)}`);
  }
  for (const [id, count] of ids) if (count > 1) found.push(`id ${id} is there ${count} times`);
  const levels = [...document.querySelectorAll("h1, h2, h3")].filter(shown).map((one) => Number(one.tagName[1]));
  levels.forEach((level, place) => { if (place && level > levels[place - 1] + 1) found.push(`a heading of level ${level} follows one of level ${levels[place - 1]}`); });
  if (document.querySelectorAll("main").length !== 1 || document.querySelectorAll("h1").length !== 1) found.push("not one main part and one first heading");
  if (!document.documentElement.lang || !document.title) found.push("no language, or no title");
  for (const one of document.querySelectorAll("[role=treeitem]")) if (!one.getAttribute("aria-level") || !one.getAttribute("aria-selected")) found.push("a row of the tree without level or selection");
  if (document.querySelectorAll("[role=tree] [tabindex='0']").length !== 1) found.push("the tree is not one stop of the tab key");
  return found;
};
