// What Material's script makes, for readers of screens and keyboards: buttons beside code have names that differ, and
// tables that scroll can be reached.
const mend = () => {
  document.querySelectorAll("nav.md-code__nav").forEach((bar, i) => bar.setAttribute("aria-label", `code block ${i + 1}`))
  document.querySelectorAll(".md-typeset__scrollwrap").forEach((wrap) => wrap.setAttribute("tabindex", "0"))
}
new MutationObserver(mend).observe(document.body, { childList: true, subtree: true })
mend()
