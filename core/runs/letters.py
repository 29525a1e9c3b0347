"""Text in pictures, in any size: a proportional typeface, smoothed, so that pictures need no library that draws."""

import base64
import functools
import zlib

import numpy as np
from numpy.typing import NDArray

from .resizing import resized

_CHARACTERS = "".join(map(chr, range(32, 127))) + "µ²³·×°±−–αβθφψΣ∫"
_EM, _ROWS, _BASELINE = 48, 51, 39
"""Pixels to the em of the stored letters, their height, and the row on which they stand."""
# DejaVu Sans; its licence is free for any use. A byte for each character's width, then one bit a pixel, column by column:
# where ink begins or ends along a row.
_BITS = (
    b"c-qxmPjBPMm9HWRu{KakbUX;u8;wZ2d$P`DBkV~BV??|AFdrdDO^^?uqYr~N{Rce`5MT#;%3(iB4(#p#d)xgA>|AmSl$#EQx%GapNERhglxz=@aH"
    b"eHbtiSKQdhhpsRdoOGXD8vmfA!+<aB$K;=pTgT6$B?ICojiGN5@}{hF`tz^^Si2%h$j7@)t*=(W|3h9gU6-4-QXW4!#`y>uB`T(dfmC;fr65z8sC"
    b"dczHM){@ZZ)G7Q3#@bIvIGB`OIMB$fFG<qrifi5@C(=gG$_{qlSex5I<&(+!GeZvDkPoJ+!`(@8{v8jMW+de*Bd^5o3ss2w0C6@X#6Ok^Mxd|0_x"
    b"kY@A^cPfAxG7cR&Lo}>#TczzlwG5H-3oPOT2aEZf}+(o)#$Qq6KcJ_M)AQ|+zH`H9$Y{_&RC*vBQF*ri1E9KtBK+2e|iX)m*!^LUrs+)8VbzM1Nw"
    b"0As~732$HM(w&f`KP_^CQ5@E1`Dc_)K?z=#tPq=+&6V1kY(5X+qtq4TJy5Lx>3^sPgky^?qGS~%fHafYdlQ_&IQfi63lcvN=jcG1r@>Xn74r5Sy8"
    b"(WS$M-lNb5k?UenI_pxQKufM0c)CknsILv?y%xhA*#S+TB|WQ8O+m~m{S8#QV2K8pE&A!Q#4dMRYxo=wc=8D*uUqjyK!}~Q2Sq|mNj)SJp#nvsdT"
    b"~V(JMYr)MRLYcW4$)qXnCJO=EW2J<4$;AM53>6lo30$6<cbQY`0X$7Z{ZIEe{!`CLOjF)}HetdYEl~0<DGOJ1ku>7bHQM2pU^go6%)1W-?ibkt<?"
    b"teA*02qbU}7hfQwmRjYs3%T$4Nq%IqZ?q2sl(?gh#9qj-XN{rn+>(Fq>pnLjL|2Dy=xQ9!}xZAD{H6UaJMMeJtX`fq)^8Sl;$6n0xGhudF-CbTiS"
    b"Z&U%DnI?kdho*!RWDuw-OdL4h^GJi@$YlKF$9R|Lzq8%Z;y{zdX-cH_}T;lR)FnH;1*4MX}M0HA5C2BQ&=urgtcfhT}v+Y&lx187mHpO>z@mR*9?"
    b"m~!&2senpMG-0f5+|t~@IPw=V2+;Q@!6L@2#B75O)M{zeZqKn#u8lSNqK@s_D6v=ZnlN4QZGSVTt&$Iqs^jmTZ<=MIOrF*??x7{bxrKUH@Z!ilz*"
    b"RY@H}=1Bv#%$H9?XZxTUAs0f$g<Jzf4URmLJ#dV#7}#*IlAaaJ%mb_-snEnnK?*>O3>3-atOq|iau^gLUUQ5};m7<x7V3NS>gsdd078y7$zBHg_>"
    b"tsD4~KD*kkS#rc9EX`+2R^fP*W|1#KT-9W|O6fo{gLJhI=@Qu!>y;oJ(xSgdYmh?LdgKV_*}OgoUkGHw?f81F$1*YML*$`Q(0{e|~sIr>7HuP+Ra"
    b"VOsEFJCH`qEaCcm7ssP7YyiQ=@X>Z&mCCmS1Oe|S$u{Hx!C50UPhrJEy9R|9XvO62Fhe|O5ttI7BFOL61u5WI<NLzn&r6{5h8q^+4+gWLUTU=G7a"
    b"|9vId8`rCfAhVDy?O>LB+O;-q`B;(w6O*Aht?-sQ4dzwK>+Yk*4J2x43%oQ$q>;LHR7Vi<`DBZ1VW3WpAK~gosOp^BDGu5vWlIUW&2L23H|qDJ+M"
    b"w!NzSB5{3_l7`YITdsS*UF1o``O{kzxmrXQ#mE_X*ZtP#Jy^_N`+50|@p5?*<;Axk^fK1gA?J8U2F!IL^&Nuh|y*m1c|8bJWn_w)!ocAK6!*0T{Y"
    b"S)%lNL8>P<a<d36DJZxDOLn0VpxrP}#8a+!S~c6A-;40k9Wam}f315-#2Qi?lty}QQvPSbmVrIstM$UaUtiI`3+xO83t!oJ06RccD|NiePI$2e4O"
    b"nTyHsOeEB^GumGF|OzzkV9@e46zB-q*-~k`0f5-!yDHsJ>$%CwB75fhV%R@(hTvzB(XgsJIM`V}FH!xDpXxbC+tnjYaEU85>*dJLAkEcg#`?)>mI"
    b"3`u~%a-rTWa393eF`k#8;I5ci`1|EkQlAwZ-MObqg)$HmELX2>TWjTb?^1xcT{{PW}ya9!zam}}ofp&W2_l^*o^=}6zP4J0kRKA<UEb-WjwO;iQf"
    b"_IR0K+!zDb%JAhz8$u6+F_LR)`=o<=f!t4Q6FQSi-}24Vvk+3H_cNAdcK2=kb_TXIvOX^LJv~P6eM#90mT~1Nn?04__vFTHtlYT)pq2aSg{(P5Wk"
    b"xQWyF>#YV&8b-i9$1)?Pg1X6JCe90Ri+HyKr95OZHtkbo0MbYCWgzCHX^CT|m+(3lKO7mvx3R<D2w93~MXLKwpR+n@{N`ByS}<w$}G5s1BOGVFe4"
    b"40{irWBS07m~iY$VXt19U&WXA`X(5QSuDJPaQPt{wp3Pj>+k|(?BMM;RidZ86;Bc{xyy}5`2QRWO9vLYr*jFls_vVf+&^7aJpDje6L)Nm^Ooax47"
    b"qk7#9%DRX-Ke`5t?w>z6WgB*oV-X+&7B+*k-vaOv((j-ZP5pj4$7uP4w@ldG_NBcCqo-t%)S`=EG^Y4Ehp72!Y+{=h~$^9nn=37{m+@iN1)ia;ls"
    b"&HZEL<)zH2x7k5zX&j=eS&{qlb-AR?-LK`v0zj%~ZwRSf1?qUA@bF8F&uFHpT^DKNC<r5libQjIjU$uOj_CxqbJi@>ddqsCmSi5}MkhkgO#+r-6<"
    b"KZFj4uJw0=KKUV*Svdl4fGVzjiXTK8l0KVG!@*HzR}K~ZqDgj@@|fC(~0qZvP=$)YmAEAauw$7>Bk;PLOzRk*gL-Xte3>XFzJNR2J>T#I<g@f2vA"
    b"3t5z)MB?FjV5+Qz^f8XMyYZ>~-Js>z|tp9Wl6O--8|Y};Jg($&0)HYV#{7Hc8F9L&z=44Bg4k&T%|+)%*f0s~$xDdyi{_!k9s0ac^}dMJxM<IA?y"
    b"wE!wb>YpM=M}?=SIPd0}zPU<V2ejvaA7Y6h6A;yQyP<8Jot6OAs+eAzwL52@GKNmCursHIVotqYE>tlvJyv?&VY`_yY~DMDZi&d+=RYbUOJQYp=b"
    b"U{;kcYeE*>buftHjNm59qh8e0B{P<~jqC3JNSqn+95yL`J0qzJeJtwg7UyMQpAKxk{sh_9?}vpRk8Zis|SZ!pYqT&^jhPMQ?@I6O%ySOqZU=1B+="
    b"*r+^YO<RC~-F87Vm&4JI?s#-kK{~;BG<3Hla5g>BNB~koJ{G@|2(U@+|$>5UlxJ#;%No*xxGkYUpU?=XY*LMK;^EsF#$&tg5p=8--OUO0`S_;5M@"
    b"v)JW=FXcY<Zu)sin1iPJbV>=drRF>iXT&$1J|XyT!KT_qrXA<eqzxy&v%6_=wjOFVE4b;7<lcnO_rTlK*cN$4-PiPjqg>oN&#P`P0s9??b^7&;&a"
    b"HGQj(_D`5qGnA(ySTJ-3M4f<mxU|I8QVo`Iey+MQ$GGVO64IG+hOk#*RRqcys~rYd@n)us&!COzzJif+|a<2Hrch%^mPZ1~1LOLN4}Px<);KVRTE"
    b"W-+Rn!NuBs$OszY<8c>wzM$$dL#HYC$z5^<nb^B2BT?2i)w#Z2*=RtT^tML5MAcY0!`F{z#lZWR?g&-7rsw*AtNApXK<N}&PykD&5s!<_c#7+ua6"
    b"BQkpre^c6QRSo{zYf%16^KTd88%vbC_Uym0%fQ1;jyRo5m`x_>j-9=}9oA!d*qFpw0;6lp?n7OUzQVA5lj%gaB%nN#W<x67YFel&NlK_L3M|8v}~"
    b"xpF&0+8|4gD9k#161}R+xi<&DAtPWfkaUWAP^#gR%RaIM(yNpwN$=Z!<bM#uT{f)JxJzd_$H|O&_Yo1I#4=^T=!6Qq94=R}r>h*fFv>;kn>KPl3*"
    b"F|BkFtO>t<|YT);Fd1)yge49hb^Z9>UqJ$;zbASv9rGA)C#_n9oT}Y&~#K0vf7WOmaE+4`dc!jZ6ayODUdllDY7+bjG?7rT$G&x^C<+*R&fxdc;K"
    b"uXY%OQyimG;F_hq&}YBz~pY{SiVQ1@IR|GBT`fl0BB3G5q(*ZP>#Qe{8iS33J-9rtDWC^O)>w|vyc=^K_Nrt{HPtn#4dcsGH_qJUQn`4~S2*hU#r"
    b"!=0gD+D#q!=KG@Ye7n=odCg^}SD-U?18nXPBY4a^XgEnA+cHk3XU<t2*i#TUd~`Ql3bU<G!-s}a!SpBAeAwa)dE7JJQi5u`9N750;8~iH#A1g}Xh"
    b"o2yBZ>oG#U|HI*8wYmFP^^kp}U+mae=&L(qU9M7R9cr>Qlz(bP(uVIKv>Zatp7;Oz*61Ovz`!4w8<ZrR@1icbiRR+64CZ;9)pdoLfTXfk_9X$eRR"
    b"0F8RCCgb!>>Zga4SwJf!rV9O@8a7Ah9cZev6FYosC9{%@~did)&z^uElPg#<;hmYDEMmfJ>92!Al`d_jTj=NM^DmRdrptCiU*&mhrQ*!%3Pcp!}s"
    b"2I0S_Rn<vnM=Oqjl7-5ViKl{U=8bNBXD;hm)EJ8d}~742ZZA_!MUzE32HmtRwrkBFcn&6Ik0I-KY!dCJl};4gs%T#D=Zi_Ws#@Ra#}W7Gog9^Cg0"
    b"cfwhK8AA4DZ(1`{kf-hn;>Oi<q-)&$oKJ0lGD8seoJy`HY&fE6#X+nQNI6;)IW)?OiMKwS@wy9N6acb6?yK12H+EI>w<%-hI-+LQN%^SfUK4mChF"
    b"g?9gdo7XmCh}QhYCO>8xF3mO(_199yH59z}#*Evtm*fA#uF8JSdGdf8PGN22rlJsB-jMPQ*#&ZQiab@8ly)1sh<S#w3GxW|Gder0Q&AJ~6Fw%1Sz"
    b"sOuL~psvj!&CiyEi%Q+a4qY(X>CmD<iUJxc2Su^~mC|FTr{~1nCX<g)+#Pb9gPaE`(_9$%wp-xJ^oQp)Gv|AweP`Z7q0Rq6my$j*8?$h?Qer8%7*"
    b"hC;!c1vR9(3hwlt~gbLGl?q-RF`|p#4E&FnlDS2MW*7>%;YisD@5ya&^NTb;dCzu=y&G@%YRAd<DE7k0e%<6MWVCTiWbL*X!U&#OsjD+E~8(z;@-"
    b">VNlnYd#PuhhI7xxDZ5`!?^@uxMM@+^|sOWF-OB>!p0bwMvsWc*<rhXk$mlx$;j47HQVBL$QNZZKP_^VBqreEr-6w7H2WHMV;BKF^0@%!p3NG0wB"
    b"nrrp4MjLz(rtA(0wXOh{P~;8QX`Y0&Tmt7^e}S~Z$wY)$q816bf)qzuiZHrLr(V_YQ@(IYmzQy#~K;j7nsu@3RktB2U!T;p}udu%p{0k@nOz``V{"
    b"G$bkUtTC~1vI90QIL7wg%?;aOQXwV9Y#h%l<pXeZc1EcGfKOFK`ALTkP>Hi7fS)v*gag)kg_M$}x4n9`AfI6M@ONxGJr>)T`OS1pEp=r2EorBN66"
    b"r)iKAp-Wdl+-a%8Ol?nw!i;v3n_b>p!*MY3Q!e{hJ*+DP~mP`KTok%G&bcv*L^o%!7|M-8EyjW1S#dr_pTmtR2_>TvW>ogl2dkZ1V-dk4!6O$SW*"
    b"Xge1x7e$vn1<Y_-=YiZq&g&9BP-OSZYd?Scr-tw7FJ)JfMw~A+=GoLZErC|(WE$LXB`!`xoW9;+Ge1U*2uaY$(Z|9nyel2X@7*`Qt6_M<6y=@{Do"
    b"n~61<vMN}1taiB3t?NDbp>$Mi`E9PX@Z;itkos{5#cq9ZPF&T!fR%W$+P^*>NPjfkwoFd8}?m{!1)I6c?X<p;qRR|r<S+yxcVCt_J%Ffnp=ZHuJ~"
    b"GP8E7TY1Dref0yZWOX+=8x_b!egVfW)ew5*~H>T9u{XZu?zh&ANyzky5xr1*|92kVFeFlX(e<Qm%%d=?K}k~y9iU9)a6<j6)LPdm{^{8l-zP7xZP"
    b";p)R0%~35jl~?#mT}NwksHM1kLL<UUDzE-*nRLV_!k&5pkYUfWZin1Y8(hfcrw8%e*Toax_W$R8xoSTk(*HXTw#CqxJsbl1dj$hRjv}4{>`d^A`k"
    b">eu2@n>dZRAi%5D`zqM@>}!zsW}@T~}BqvJ~Ucgiea$h>gS%RGB(u7E|p`?7m*W!}wW6Pt{KJP{jO@r(WrIw9|?Gq$!wNUj%rO{D^s&Fr{6p7zuz"
    b"Uf^SoL%jqVKh2O`E);dK;R8l;IJ@%KUC_6z?z=;k2l^92SqMYO^^V7uq^#(o&N}<_lKh?<;m|}#k_(htO-UgAraOpteh*&mr;Bdfd;^U@%8nTONB"
    b"fv6f%;g|HC@D41U4Uh~qB9}9$)%Wu3oztUJKxvp=`ZWM{&At#g)PPy|0vtIWu!5q#7w&Rl_-u?n!`2&ZqB6W54+jW!p?HL7DxHONXTp-*Ni_}XRS"
    b"9M8TD7@@^+n(zAa(lG*4}Q)+rNeckg2h^e4!|;vFk3A-7!gB`pfI#dK~*zQ@57o%Pc5YaD1%CkUh0wrz9tH)j(5up+PRxPR9qsRk<}E7`1V#Nm%W"
    b"<@b>f0-TST@E;`8>rzq@b%{i(1~5{qof_G{fpqwPVX*`D"
)


def lettered(text: str, size: float) -> tuple[NDArray[np.float32], float]:
    """A line of text, `size` pixels to the em: how much ink is where (rows, columns), 0 to 1, and the baseline's row.

    A character that is not known is "?".
    """
    letters = _letters()
    ink = np.concatenate([letters.get(character, letters["?"]) for character in text or " "], axis=1)
    share = size / _EM
    shape = max(1, round(ink.shape[0] * share)), max(1, round(ink.shape[1] * share))
    return resized(ink[..., None], *shape)[..., 0], _BASELINE * shape[0] / _ROWS


def width(text: str, size: float) -> float:
    """Pixels that a line of text takes along its baseline."""
    letters = _letters()
    return sum(letters.get(character, letters["?"]).shape[1] for character in text) * size / _EM


@functools.cache
def _letters() -> dict[str, NDArray[np.float32]]:
    """Each character's ink (rows, its width)."""
    stored = np.frombuffer(zlib.decompress(base64.b85decode(_BITS)), np.uint8)
    widths, bits = stored[: len(_CHARACTERS)].astype(int), np.unpackbits(stored[len(_CHARACTERS) :])
    flips = bits[: widths.sum() * _ROWS].reshape(-1, _ROWS)
    ink = np.bitwise_xor.accumulate(flips, axis=0).T.astype(np.float32)
    return dict(zip(_CHARACTERS, np.split(ink, np.cumsum(widths)[:-1], axis=1), strict=True))
