"""Contrasts, as the browser mixes colours (WCAG 2.2, success criteria 1.4.3 and 1.4.11)."""

# Contrasts of every word with its ground, and of the plots' colours with theirs: [ratio, what]. Colours are
# laid over one another by the browser itself; behind what stands over the faces may be any colour, so that the worse of
# black and white counts.
CONTRASTS = """(() => {
  const dot = Object.assign(document.createElement("canvas"), { width: 1, height: 1 });
  const pen = dot.getContext("2d", { willReadFrequently: true });
  const style = getComputedStyle(document.body), named = (name) => style.getPropertyValue(name);
  const mixed = (colours) => {
    for (const colour of colours) (pen.fillStyle = colour), pen.fillRect(0, 0, 1, 1);
    const [r, g, b] = [...pen.getImageData(0, 0, 1, 1).data].map((each) => {
      each /= 255;
      return each <= 0.04045 ? each / 12.92 : ((each + 0.055) / 1.055) ** 2.4;
    });
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ratio = (under, colour) => {
    const [low, high] = [mixed(under), mixed([...under, colour])].sort((a, b) => a - b);
    return (high + 0.05) / (low + 0.05);
  };
  const found = ["--quiet", "--wave", "--line-1", "--line-2", "--line-3", "--line-4", "--accent"].map((name) => [
    ratio([named("--ground")], named(name)), name]);
  for (const ground of ["--ground", "--raised"]) { // borders of controls: 3:1 is enough
    found.push([ratio([named(ground)], named("--edge")) * 1.5, "--edge"]);
  }
  for (const element of document.querySelectorAll("body *")) {
    if (![...element.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim())) continue;
    if (!element.checkVisibility({ visibilityProperty: true }) || element.closest("select option, noscript")) continue;
    const grounds = [];
    for (let each = element; each; each = each.parentElement) grounds.unshift(getComputedStyle(each).backgroundColor);
    const bases = element.closest("#stage") ? ["#000", "#fff"] : ["#fff"];
    const ink = getComputedStyle(element).color;
    for (const base of bases) {
      const under = element.closest("#stage") ? [base, ...grounds.slice(3)] : [base, ...grounds];
      found.push([ratio(under, ink), `${element.tagName} ${element.className} ${element.textContent}`]);
    }
  }
  return found;
})()"""
