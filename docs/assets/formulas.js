// Formulas are typeset by the copy of KaTeX beside this file: the site loads nothing from elsewhere.
document.querySelectorAll(".arithmatex").forEach((element) => {
  const text = element.textContent.trim();
  katex.render(text.slice(2, -2), element, { displayMode: text.startsWith("\\[") });
});
