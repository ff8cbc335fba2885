"""How a report looks: on a screen, light or dark, on a phone, and on paper."""

STYLE = """\
:root { --text: #1c2430; --faint: #667085; --line: #dfe3e8; --card: #ffffff; --back: #f6f7f9;
  --accent: #2b7bba; --mark: #fff0c2; --good: #1a7f45; --wait: #a15c00; --bad: #b42318; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e4e7ec; --faint: #98a2b3; --line: #344054; --card: #1b222d; --back: #12171f;
    --accent: #6cb2e8; --mark: #5a4a12; --good: #5fd08d; --wait: #f0b35a; --bad: #ff8a80; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.25rem 3rem; max-width: 70rem; background: var(--back); color: var(--text);
  font: 1rem/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", "DejaVu Sans", sans-serif; }
h1 { margin: 0; font-size: 2rem; line-height: 1.2; overflow-wrap: anywhere; }
h2 { margin: 0 0 0.75rem; font-size: 1.15rem; }
p { margin: 0 0 0.75rem; max-width: 60rem; }
section { margin-top: 2.25rem; }
code { font-family: ui-monospace, Menlo, Consolas, "DejaVu Sans Mono", monospace; font-size: 0.85em;
  overflow-wrap: anywhere; }
mark { background: var(--mark); color: inherit; border-radius: 3px; padding: 0 0.25em; }
.what { margin: 0.25rem 0 0; color: var(--faint); overflow-wrap: anywhere; }
.state { display: inline-block; vertical-align: middle; padding: 0.2rem 0.7rem; border: 1px solid currentColor;
  border-radius: 1rem; font-size: 0.8rem; font-weight: 600; line-height: 1.2; }
.finished { color: var(--good); }
.unfinished { color: var(--wait); }
.failed { color: var(--bad); }
.box { margin-top: 1rem; padding: 0.75rem 1rem; max-width: none; border-left: 4px solid var(--wait);
  background: var(--card); overflow-wrap: anywhere; }
.notes { padding-left: 2rem; }
.tiles { display: grid; grid-template-columns: repeat(auto-fill, minmax(11.5rem, 1fr)); gap: 0.75rem; margin: 0; }
.tile, .card { margin: 0; padding: 0.7rem 0.85rem; border: 1px solid var(--line); border-radius: 8px;
  background: var(--card); }
.text { margin-top: 0.75rem; grid-template-columns: repeat(auto-fit, minmax(min(100%, 22rem), 1fr)); }
dt { color: var(--faint); font-size: 0.85rem; }
dd { margin: 0; overflow-wrap: anywhere; }
.number { font-size: 1.6rem; font-weight: 600; line-height: 1.3; font-variant-numeric: tabular-nums; }
.remark, .tags { color: var(--faint); font-size: 0.85rem; font-weight: 400; }
.bound { font-size: 1.3rem; font-weight: 600; }
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 26rem), 1fr)); gap: 0.75rem;
  margin-bottom: 0.75rem; }
.grid > section { margin-right: 1.25rem; }
.grid.wide { grid-template-columns: 1fr; }
figcaption { margin-bottom: 0.25rem; font-weight: 600; }
figcaption .tags { display: block; }
svg { display: block; width: 100%; height: auto; }
svg text { font-family: system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", "DejaVu Sans", sans-serif; }
.picture { background: #ffffff; color: #1c2430; }
.picture img { display: block; margin: 0 auto; max-width: 100%; height: auto; }
table { width: 100%; border-collapse: collapse; font-size: 0.9rem; }
th { padding: 0.2rem 1rem 0.2rem 0; width: 50%; text-align: left; font-weight: 400; color: var(--faint);
  vertical-align: top; overflow-wrap: anywhere; }
td { padding: 0.2rem 0; vertical-align: top; overflow-wrap: anywhere; }
tr { border-bottom: 1px solid var(--line); }
.configuration { display: block; columns: 24rem 2; column-gap: 2.5rem; }
.configuration tbody { display: block; }
.configuration tr { display: flex; break-inside: avoid; }
.configuration td { flex: 1; }
@media print {
  :root { --back: #ffffff; }
  body { padding: 0; font-size: 10pt; }
  .card, .tile, tr { break-inside: avoid; }
  h2 { break-after: avoid; }
  .grid { grid-template-columns: 1fr 1fr; }
}
"""
