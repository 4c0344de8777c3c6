"""Texts that would run in a page that took them for markup, code or an address."""

from __future__ import annotations

RUN = "top.ran=(top.ran||'')+'{k},'"
"""What each runs, were it not text: it leaves its number in the browser's outermost window."""

INJECTIONS = (
    "<script>{run}</script>",
    "</script><script>{run}</script>",
    "</SCRIPT ><sCrIpT>{run}</sCrIpT>",
    "--></script><script>{run}</script>",
    "<!--<script>--><script>{run}</script>",
    "]]><script>{run}</script>",
    "</style><script>{run}</script>",
    "</title><script>{run}</script>",
    "</textarea></noscript></template></select><script>{run}</script>",
    "</pre></td></table></h1></p><script>{run}</script>",
    '"><script>{run}</script>',
    "'><script>{run}</script>",
    '"><img src=x onerror="{run}">',
    "'><img src=x onerror='{js}'>",
    "<img src=x onerror={bare}>",
    "<img/src='x'/onerror={bare}//",
    '" autofocus tabindex=0 onfocus="{run}" x="',
    "' autofocus tabindex=0 onfocus='{js}' x='",
    '<svg onload="{run}">',
    "<svg><script>{run}</script></svg>",
    '<svg><animate onbegin="{run}" attributeName=x dur=1s>',
    '<math><mtext><img src=x onerror="{run}">',
    '<details open ontoggle="{run}">',
    '<video><source onerror="{run}"></video>',
    '<audio src=x onerror="{run}">',
    '<object data=x onerror="{run}"></object>',
    '<iframe srcdoc="<script>{js}</script>"></iframe>',
    '<iframe src="javascript:{js}"></iframe>',
    '<iframe src="data:text/html,<script>{js}</script>"></iframe>',
    '<object data="data:text/html,<script>{js}</script>"></object>',
    '<a href="javascript:{js}" class=pressed>a</a>',
    "[a](javascript:{js})",
    "![a](https://elsewhere.example/a.png)",
    '<link rel=stylesheet href="https://elsewhere.example/a.css">',
    '<meta http-equiv=refresh content="0;url=https://elsewhere.example/">',
    '<base href="https://elsewhere.example/">',
    "<style>@import 'https://elsewhere.example/a.css';*{{display:none}}</style>",
    "</style><style>body{{background:url(https://elsewhere.example/a.png)}}</style>",
    '<form action="https://elsewhere.example/"><button autofocus>',
    '<input autofocus onfocus="{run}">',
    "\u2028{run}//\u2029",
    '";{run};//',
    "';{run};//",
    '\\";{run};//',
    "`;{run};//${{{run}}}",
    '{{{{constructor.constructor("{js}")()}}}}',
    "${{{run}}}$shown$data",
    "{{{run}}}",
    '`*<img src=x onerror="{run}">*`',
    "\x00<script>{run}</script>",
    "\ufeff<script>{run}</script>",
    "+ADw-script+AD4-{run}+ADw-/script+AD4-",
    "&lt;script&gt;{run}&lt;/script&gt;&#60;script&#62;{run}&#60;/script&#62;",
    "\x1b]0;x\x07<script>{run}</script>",
)
"""Templates; `injection` fills them in."""

ONLY_TEXT = ("{{{{const", "+ADw-", "&lt;", "[a](", "{{{run")
"""How those start that run in no page here: for templates, UTF-7, Markdown and double decoding."""


def injection(k: int) -> str:
    """Fill in the k-th, counted on from the last to the first again."""
    k %= len(INJECTIONS)
    js = f"top.ran=(top.ran||[])+[{k}]+/,/.source"
    return INJECTIONS[k].format(run=RUN.format(k=k), js=js, bare=js)
