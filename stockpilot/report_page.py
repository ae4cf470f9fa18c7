"""The frame and the style of report.html: nothing is fetched from anywhere, light and dark, good on paper."""

STYLE = """
:root{--ink:#1d232a;--dim:#5c6670;--line:#dde2e7;--card:#fff;--back:#f5f6f8;--accent:#0072b2;--bad:#b84300;--warn:#fff4dc}
@media (prefers-color-scheme:dark){:root{--ink:#e7ebef;--dim:#9aa5b0;--line:#333b44;--card:#1c2228;--back:#12161a;
--accent:#56b4e9;--bad:#ff9457;--warn:#3a2f14}}
*{box-sizing:border-box}
body{margin:0;background:var(--back);color:var(--ink);font:15px/1.5 system-ui,"Segoe UI",Helvetica,Arial,sans-serif}
main{max-width:1080px;margin:0 auto;padding:28px 20px 40px}
header p{margin:0;color:var(--dim);letter-spacing:.04em}
h1{margin:0 0 18px;font-size:26px;font-weight:650}
h2{margin:0 0 10px;font-size:16px}
.badge{font-size:13px;font-weight:600;padding:3px 10px;border-radius:11px;vertical-align:4px;color:#fff;background:var(--bad)}
.badge.ok{background:#00795a}
section{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:18px 22px;margin:0 0 16px}
.hero{display:grid;grid-template-columns:1.2fr 1fr;gap:30px;align-items:center}
.hero p{margin:0 0 4px;color:var(--dim)}
.hero .volume{font-size:42px;line-height:1.15;font-weight:700;color:var(--ink);font-variant-numeric:tabular-nums}
svg{width:100%;max-width:460px;margin-top:8px}
.axis{stroke:var(--line);stroke-width:2}.interval{fill:var(--accent);opacity:.35}.estimate{fill:var(--accent)}
.truth{fill:var(--bad)}.mark{font-size:12px;fill:var(--dim);text-anchor:middle}
.bar{display:flex;height:22px;border-radius:4px;overflow:hidden;border:1px solid var(--line)}
.bar i{min-width:2px}.seen{background:#0072b2}.interpolated{background:#e69f00}.unseen{background:#d55e00}
.legend{list-style:none;display:flex;flex-wrap:wrap;gap:4px 18px;margin:10px 0 0;padding:0}
.legend b{display:inline-block;width:12px;height:12px;border-radius:3px;margin-right:6px;vertical-align:-1px}
.legend em{font-style:normal;font-weight:600}
.warnings{background:var(--warn);border-color:#e69f00}.warnings ul{margin:0;padding-left:20px}
.pictures{padding:10px}figure{margin:0 0 10px}figure img{display:block;width:100%;max-width:900px;margin:0 auto;background:#fff;
border-radius:4px}figcaption{text-align:center;color:var(--dim);padding:4px 0 8px}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}
th{font-weight:400;text-align:left;color:var(--dim)}td{text-align:right}th,td{padding:5px 0;border-bottom:1px solid var(--line)}
tr:last-child>*{border-bottom:0}
footer{color:var(--dim);font-size:13px}
@media (max-width:760px){.hero{grid-template-columns:1fr}.hero .volume{font-size:34px}}
@media print{body{background:#fff}section,figure{break-inside:avoid}}
"""

PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body><main>
{body}
<footer>{made}. Volumes in cubic metres; heights above the floor as fitted; the interval counts what the map can tell of
itself and takes the sensor's range to be true to 2 mm (1σ).</footer>
</main></body>
</html>
"""
