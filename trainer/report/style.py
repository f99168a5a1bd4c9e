# SPDX-License-Identifier: GPL-3.0-or-later
"""Style sheet of the report page."""

STYLE = """
:root { color-scheme: light dark; --ink: #1c1f24; --soft: #666d78; --paper: #fff; --card: #f5f6f8; --line: #dfe2e7;
  --fdda: #e2711d; --linear: #b9c0cb; --train: #7b93b8; --worst: #b03a7a; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8eaee; --soft: #98a0ad; --paper: #16181c; --card: #1f2228;
  --line: #343942; --linear: #545c69; --train: #7d9ccc; --worst: #d66aa5; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1080px; padding: 40px 28px 80px; background: var(--paper); color: var(--ink);
  font: 15px/1.5 system-ui, "Segoe UI", "Helvetica Neue", Arial, sans-serif; font-variant-numeric: tabular-nums; }
h1 { font-size: 26px; margin: 0; font-weight: 650; } h2 { font-size: 17px; margin: 44px 0 4px; font-weight: 650; }
p { margin: 2px 0 14px; color: var(--soft); } p strong { color: var(--ink); }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px; margin-top: 22px; }
.card { background: var(--card); border-radius: 8px; padding: 12px 16px; }
.card b { display: block; font-size: 23px; font-weight: 650; line-height: 1.25; }
.card span { color: var(--soft); font-size: 12.5px; } .card.main b { color: var(--fdda); }
.multiples { display: grid; grid-template-columns: repeat(auto-fill, minmax(215px, 1fr)); gap: 14px; }
figure { margin: 0; } figcaption { font-size: 13px; color: var(--soft); } figcaption b { color: var(--ink); }
svg { display: block; width: 100%; height: auto; overflow: visible; }
.grid { stroke: var(--line); } .tick { fill: var(--soft); font-size: 10px; }
.label { fill: var(--ink); font-size: 12px; }
.curve { fill: none; stroke-width: 1.6; stroke-linejoin: round; }
.curve.training { stroke: var(--train); } .curve.validation { stroke: var(--fdda); }
.curve.worst { stroke: var(--worst); stroke-width: 1; }
.bar.linear, .area.linear { fill: var(--linear); } .bar.fdda, .area.fdda { fill: var(--fdda); }
.area { fill-opacity: .78; } .most { stroke: var(--fdda); stroke-width: 2; }
.key { display: inline-block; width: 11px; height: 11px; border-radius: 2px; margin: 0 5px 0 12px; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; width: 100%; font-size: 13px; white-space: nowrap; }
th, td { padding: 4px 8px; text-align: right; border-bottom: 1px solid var(--line); } th { font-weight: 600; }
th:first-child, td:first-child { text-align: left; } thead th { color: var(--soft); } tr.total td { font-weight: 650; }
.pictures { display: grid; gap: 20px; } .pictures img { width: 100%; border-radius: 8px; display: block; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 2px 18px; font-size: 13px; margin: 8px 0; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
"""
