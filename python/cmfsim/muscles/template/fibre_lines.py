"""The parts of BodyParts3D release 3.0 that make a muscle template: ids, our names, hashes.

Ids are those of the Foundational Model of Anatomy (FMA), by which the files are called.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import MeshInputError
from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData


class MusclePair(NamedTuple):
    """A muscle on either side: its name without side, its kind, its parts on the right and left."""

    name: str
    kind: str
    right: str
    left: str


PAIRED_MUSCLES = (
    MusclePair("masseter_superficial", "strap", "FMA49001", "FMA49002"),
    MusclePair("masseter_deep", "strap", "FMA49004", "FMA49005"),
    MusclePair("temporalis", "fan", "FMA49007", "FMA49008"),
    MusclePair("medial_pterygoid", "strap", "FMA49012", "FMA49013"),
    MusclePair("lateral_pterygoid_lower", "strap", "FMA49022", "FMA49023"),
    MusclePair("lateral_pterygoid_upper", "strap", "FMA49024", "FMA49025"),
    MusclePair("buccinator", "sheet", "FMA46835", "FMA46836"),
    MusclePair("orbicularis_oculi_orbital", "ring", "FMA46782", "FMA46783"),
    MusclePair("orbicularis_oculi_palpebral", "ring", "FMA46785", "FMA46786"),
    MusclePair("zygomaticus_major", "strap", "FMA46812", "FMA46813"),
    MusclePair("zygomaticus_minor", "strap", "FMA46814", "FMA46815"),
    MusclePair("levator_labii_superioris", "strap", "FMA46806", "FMA46807"),
    MusclePair("levator_labii_alaeque_nasi", "strap", "FMA46803", "FMA46804"),
    MusclePair("levator_anguli_oris", "strap", "FMA46823", "FMA46824"),
    MusclePair("depressor_anguli_oris", "fan", "FMA46829", "FMA46830"),
    MusclePair("depressor_labii_inferioris", "strap", "FMA46817", "FMA46818"),
    MusclePair("mentalis", "strap", "FMA46826", "FMA46827"),
    MusclePair("risorius", "strap", "FMA46839", "FMA46840"),
    MusclePair("platysma", "sheet", "FMA45739", "FMA45740"),
    MusclePair("frontalis", "sheet", "FMA46759", "FMA46760"),
    MusclePair("occipitalis", "sheet", "FMA46761", "FMA46762"),
    MusclePair("temporoparietalis", "sheet", "FMA46763", "FMA46764"),
    MusclePair("procerus", "strap", "FMA55610", "FMA55611"),
    MusclePair("nasalis", "strap", "FMA55606", "FMA55607"),
    MusclePair("corrugator", "strap", "FMA46796", "FMA46797"),
    MusclePair("depressor_septi_nasi", "strap", "FMA55608", "FMA55609"),
    MusclePair("digastric_anterior", "strap", "FMA46304", "FMA46305"),
    MusclePair("digastric_posterior", "strap", "FMA46306", "FMA46307"),
    MusclePair("stylohyoid", "strap", "FMA45826", "FMA45827"),
    MusclePair("mylohyoid", "sheet", "FMA46321", "FMA46322"),
    MusclePair("geniohyoid", "strap", "FMA46326", "FMA46327"),
    MusclePair("sternocleidomastoid", "strap", "FMA13408", "FMA13409"),
)
# Name, kind and part; two halves that meet in the midline.
MIDLINE_MUSCLES = (("orbicularis_oris", "ring", "FMA46841"),)
# Bones of skull and jaw, in the order of their ids.
BONES = (
    "FMA9710",  # vomer
    "FMA52734",  # frontal bone
    "FMA52735",  # occipital bone
    "FMA52736",  # sphenoid bone
    "FMA52738",  # right temporal bone
    "FMA52739",  # left temporal bone
    "FMA52740",  # ethmoid
    "FMA52748",  # mandible
    "FMA52788",  # right parietal bone
    "FMA52789",  # left parietal bone
    "FMA52892",  # right zygomatic bone
    "FMA52893",  # left zygomatic bone
    "FMA53645",  # right lacrimal bone
    "FMA53646",  # left lacrimal bone
    "FMA53647",  # right nasal bone
    "FMA53648",  # left nasal bone
    "FMA53649",  # right maxilla
    "FMA53650",  # left maxilla
    "FMA53655",  # right palatine bone
    "FMA53656",  # left palatine bone
    "FMA54737",  # right inferior nasal concha
    "FMA54738",  # left inferior nasal concha
)
TEETH = (
    "FMA55680", "FMA55681", "FMA55682", "FMA55683", "FMA55686", "FMA55687", "FMA55688", "FMA55689",
    "FMA55690", "FMA55691", "FMA55692", "FMA55693", "FMA55694", "FMA55695", "FMA55697", "FMA55698",
    "FMA55699", "FMA55700", "FMA55703", "FMA55704", "FMA55705", "FMA55706", "FMA55798", "FMA55799",
    "FMA57140", "FMA57141", "FMA57142", "FMA57143",
)  # fmt: skip
# SHA-256 of the OBJ files, 99 % reduced, as they lie in the repository that the importer names.
HASHES: Mapping[str, str] = MappingProxyType(
    {
        "FMA9710": "2937ec1a9c2721a36d80cfd203785b1539917eda2588daacebf8d7084d7923d4",
        "FMA13408": "2c50fb8a1ba7babbfb9fa7f13b6cddae43adec12746240dc22912c62e52e427c",
        "FMA13409": "63cc196a0df1a727a18b1142e25cb39c95ef3deda2862465b8f5fa5b74d60432",
        "FMA45739": "756ba259598e16c055518827eb54605a47f306da555fea3c9d17af8cf9b63e56",
        "FMA45740": "9ee35cf3f0e4796ca1337d4333bf57cc4ef687ba3b5cf274664f60f062941db1",
        "FMA45826": "51fbd4b17f07369ef04134284266e51aa9f9164dbcc36e9063a7937e0333561b",
        "FMA45827": "59115157ad9ab18aafc300d44e97a9d98defd08843272fdf0b0a60415d18c00a",
        "FMA46304": "19465094df4dc0483e2448939b7cd51ac73fd253176d76f4f404981a9a01e566",
        "FMA46305": "1497199a9b4cdc4b1cabd4eff6d180acf3786e734f290be1ea024e62923b35ae",
        "FMA46306": "c36b1de255696f0b55ef2a5e912e0b1837c550e43f3add9cf1337f40379228c5",
        "FMA46307": "3cd23cf7ae7be22dd858180a4d170aa4c109fcbbd3e89ee2a325e7fb1c56c39c",
        "FMA46321": "ab1c92df421cbceb9bb14e93dc99f8798e58480daf756d4b4ffdf61083e71e5d",
        "FMA46322": "9a85ebe52a3425b197f7e7de758ae4c52dc8016d13983d6bee0d57cc20ac8fea",
        "FMA46326": "ebb041c58ec3de63a3c4fe4afef60cc727f97f3a2a4b2f9f0cf163d21edf2ca5",
        "FMA46327": "b4ae1f1bf94afa55ac5f4c66c107f00cdc154c06ac75cbf640ccc2c22e3efe46",
        "FMA46759": "2b7aa37e08dea373142180f5b355b8dd7ae202c31544791424f6899b9dd5867c",
        "FMA46760": "251fe98cdb483c1c10fb6a526dbbdd0a088e296520ad354e1e0cefab78b51757",
        "FMA46761": "c5ce61faaca8bc08da60934d4ec0529510fbae8aa33341bde74883efd2bb6f18",
        "FMA46762": "c4b81bc1d448229a1fe7b5c3a654d62a99eb2e76144e17f200a35b1b95e52e86",
        "FMA46763": "9d7dbce009e19cfe6d9b77420e0d6e203929d3e1512213f9e3bf15599ea3d013",
        "FMA46764": "2b574d7f5d6bb1954cc8fecf77f5706c8c552d72a81c57d5f35ef31635b74816",
        "FMA46782": "102643ece7b314973e0dfb60210d433fae348768712b6ccd4ba6efe079ce9b49",
        "FMA46783": "6cafcf5f2218c172efee8a292cd3d49a723fb57475c8f7ae5cec8508985534b4",
        "FMA46785": "e58f4bd556d22fbbfd187be1839e1e6f0796114e98809e9da966070c3a7a8823",
        "FMA46786": "d73cc460c8c3317a39fb5524ecdc34bee61fac752de80897f624dc1cb63da283",
        "FMA46796": "86c58c1235ef63b59bed09c67e76f06d0437169f82dc2b14ec8f2aeb4c14ac6a",
        "FMA46797": "07c84e60c3e5f7dbad0ede2499236b937d7004ffbc23f582a6eb7441f0476ead",
        "FMA46803": "a1a0a9302708c4c892d4d4dc8e07da480400ed154697a4ac352bc6506d4929b1",
        "FMA46804": "9f910725c0977e43e76929401b979eef9e91ad6dda3146b45550fa4f9ece98e2",
        "FMA46806": "b5235af5159adc20f75517781cac9c6b5d0d59b20d3d4c17ad833f5a9a639bb2",
        "FMA46807": "5f941ea869e811ec578816bfa7d2991e729aad22aa2126cc61a6e6ec4542e541",
        "FMA46812": "5db211e6172968517d9dc11ed7b833abeaf7e4e4bd7ecdad84911a298d55d01c",
        "FMA46813": "ae3272800a570cfaf7b271a262fd27abcf7f1428a57612440c68d0447313741a",
        "FMA46814": "46fc3eac0b688c1adc20b186146a67fae55bdefe978511825b727c327c5f1742",
        "FMA46815": "f0ececd8a41843b52d2cdc687250aa1190daaa57cf52142c6716bb637225ec1e",
        "FMA46817": "42b01452daeedf55616db33c44760a11ba2dfcf881b6282c2e6aa646cfeab312",
        "FMA46818": "dc70827f7df1e1ebbe2a663c9e7b3227bddc761edf033867b91eea4fe2f631e3",
        "FMA46823": "ea61d859692f535b9b68bfee23281ed70b5d5a40db6ebae8bd5d7fb733a0fc03",
        "FMA46824": "99a3b7d339e4ae4e88147354f6d0fea6ce69614fdaacbbc342439b400e72e9b4",
        "FMA46826": "7d5c37cfc1d12e9ec700d0897ea159802c113236ff637e38cfa2a60a70a311f4",
        "FMA46827": "fb88ecc2e0a2cdee3c51c27d80469b34bc0e5aa8bcdf54221c76d1d93e334759",
        "FMA46829": "802f289620681a849cc5ddff3d14ec870c16857444c669b3030beec7caa475b0",
        "FMA46830": "f57ff98668324825c5bac16e946f02b4ad4f3e885920e15c499f4850495bffbc",
        "FMA46835": "3d9e688726256e062e770a3ee4daf014dd779231855f75b0bcdc7cfc9a21020a",
        "FMA46836": "b8669c92908b4b5b708ab4dcde713743fc73c3bfe936ebeab60bb9edc89f9cdc",
        "FMA46839": "3748437839fae2e65abc86f756ad976b79dc6cce3b9b5e078d5bf7e2213748c4",
        "FMA46840": "e43b75f4fa021862413b8eaa83d8289794181b66f982e7853e1ad106d4861d4a",
        "FMA46841": "2ddf8348b1361bf8bcab40aeb6bff8abdd7dc32cc9c3ad6b4065ba9b817e573a",
        "FMA49001": "3e8ef37765a667f0fb729800619a48d5dfe6bd99f281375fa5bc1786930cdcc7",
        "FMA49002": "f4b6f6c4cb124866663d6357eb41067526eaa59a12a9da0b30551f01dbf09d60",
        "FMA49004": "1739fb75e200ee86062dff55bfe2764b9676b05cbfc498a11a0b841c9ba8c1d8",
        "FMA49005": "3ad1f17d0873129be3f3b2252c8da68592d1721428e009b4c42877cb1cd977cf",
        "FMA49007": "49350b11e23432de5d6fa9f1888a6e2da1db0b5389b2baedb7346f179ed0b9dd",
        "FMA49008": "726dc265301351f5132093ec81f78e3e2c290631caf1dad65dcac56dc56f3447",
        "FMA49012": "4d9d02d9ce76d8c85b7d466b7cfb333382996e2f66ceb28145664dc60a1f8967",
        "FMA49013": "85f718ff6d1cedd1537036be6ed733334176d7ed880bbc1c31af5e32b3f658a9",
        "FMA49022": "ab457db3530bffd621f63cb831e6f5cbe6eb8d3c7e2a24a274dcecb4e1ebb6b6",
        "FMA49023": "5cd792dd49aa3720bda2802052c7832ce6f7b3ab94a349febb2af52bdaf8ac2b",
        "FMA49024": "088614f4ec9d1e26a79a03692cd0e8555058edc7f5596dc84a4a0e8835bc5ffc",
        "FMA49025": "3eaf1691044231a2330a5ce3825718e51cc38c33c85db6e97be4a655974d0087",
        "FMA52734": "dd455c1252b2b240912900fc6aecd110f98ab737549fd2b3783c33db68e658d1",
        "FMA52735": "5d83793483f514f6954ba27ed120984d7d25437d8e8fad2c9c1f164f8cf62f44",
        "FMA52736": "dd806e7a764156e3e586b7f22aeb56549471da58d7f3e4b6edb9e1d2a31ed01c",
        "FMA52738": "d3df8957adfbfc59d4b82be33eaa068422fe4eb73e35fa37f3aff7afe00e0b68",
        "FMA52739": "af071c8188f3663aa0fdac4084981a9e68567c7a5086217263da76c0e986b39f",
        "FMA52740": "26af5156db5ec0623639d6e2c3e18993849b96797f95f20b52733306ac245bb2",
        "FMA52748": "9e4805e0a3553498e5fecdc5db12475bf58fef2264a8eb392fe42d5835ceb9b9",
        "FMA52788": "e6fdb5d395dcf65156e1317ce5ad6c376a7c1c0df1460df342c2f686b6c774cb",
        "FMA52789": "0e548ee045ad1fc54ad5cbbcb75b7eab3681120bba07595a810d83d54d1162b9",
        "FMA52892": "e57302455f4dafd42e1ebbd25a6af3d8979574eec5d829f7d3877caae2854018",
        "FMA52893": "564471ddf4784dcdb17001ae9635441f0d9c10e69988f7a950921ab323a93195",
        "FMA53645": "c1bd5a971c2246e77746ea7bdc6f41abdf0648886a3fc7fb74871b85f619a13b",
        "FMA53646": "9ba4c69bf48347c69c08d58d3b96e8e3936f72280b909a6c306eb344ec766257",
        "FMA53647": "8166989d81d2a849a3490c4d0202dd3973141e5fc417e4ff614f9fc5b34eafe7",
        "FMA53648": "1322f08cf079bcd2a8ddc7a2409d522ee149c0b075e331abca19cb9a9c1cbe9f",
        "FMA53649": "1efbed60f33e8ea4f8554009ee08dadcd65deecd07e13adef416053f0a760c31",
        "FMA53650": "1e1a4640be1f8856f2a0185869df19531e8fe6113c530290a6cbc7950fd57613",
        "FMA53655": "9d3509ea400f6034d613a87cfda1426b017213bc5cdc151e7ce974739d5631a4",
        "FMA53656": "9465a50a48d67b62fc2849e341158cc5b12d1fd3541f9800bd762d662f73881b",
        "FMA54737": "8b67264f8ab210f3f335cf8c60928d21bb556f4c08ce1930301c8392ea10fcb3",
        "FMA54738": "8497fed2e04a4aee990a83b1991848dc75b86ce4397cb97634e35e44b51f731e",
        "FMA55606": "68591bed6767a405ef63734939a193e2449ae6fc5b403ef585e29742e126a8c6",
        "FMA55607": "0900b933f4cfa1d5f586228bf1d51a163bbd94f64e653b168eeeffe55f982aea",
        "FMA55608": "cd2878a96f50def54836c2cd55af91def4080d83add77cd52c818b59e55c2285",
        "FMA55609": "9f4ffb20de4dcb6013a87180f8fdfd7060c5971595e1e3f48ac15127ddb93cce",
        "FMA55610": "d14b31bcde616896043305dccc4e54f268b4aacf9936013c2d2e3d85fe3dc86e",
        "FMA55611": "191f113958bc5ad7a377d9c23340e9da61aaebd9d38ceaa40b550410ee5a7dd0",
        "FMA55680": "1028aeb89617ba00bbe36d9eac8cfd24b4fb63ecd013ba25f558cdbc37429302",
        "FMA55681": "0f07f7bee9a4a0c2e053634d93f837fc6e2aaa35c86d70e1600e0c86b43b9a83",
        "FMA55682": "dfb71e95ee05623c03f768c3c9f91924572125c16eafef1ab5ad2a037a940d61",
        "FMA55683": "b5c9cdc3a1ca0ea774b2ef0a73581c64e327c4ebe02618f7e776dc7738ca5f34",
        "FMA55686": "3d3690881e007262d439217dca5804d8d23aea832f00b77034694577b2c65ff2",
        "FMA55687": "91da28abcf17dab545b8eeb86cf70a15496331dbd0be807c1a2290989838b394",
        "FMA55688": "11f3795442cecee4fbe003b0495223ec9a5c9eb50da169e4514727e21013192b",
        "FMA55689": "ceba07acafb6ade9e76b1399cf31957fc1a1c62e7e281da6f834268e6fda2f62",
        "FMA55690": "a11f598d3944c6172a55901c0ebced3ef720810bab4f9ddbedff1e6f36df50d0",
        "FMA55691": "7e28d7dbfb78fdb89823f4919d682c5ebbb385a277134b51e6b32d0c63789680",
        "FMA55692": "b9587c7f364877d419f00f0baeb80a0f7e1f88bba328e0916ed30cb2c734e87d",
        "FMA55693": "1aa1abbc8a3de96e628dcd1c9a0f31081e323586f32bf88d03006ce762591169",
        "FMA55694": "83cf6b9e44fbab3200389bd8f95787eb3e726fd03b9fb549b873d1495083003c",
        "FMA55695": "8f175c4c30da18f5482df23471a49acabe7cf4808d7dd71709a0e1a4fcbe84d0",
        "FMA55697": "09af9fa39963b7fa23f88b35614a98102b9b36d18e7c17b2137bb8f3322dbd79",
        "FMA55698": "26d5bdca20c43957063157949a423caa8045cd5dcab5deb826212b827234fde5",
        "FMA55699": "8d412cfb548c5bbe08eebe0a33a3ebe19692f87b4cdeb912a313a267ee817a83",
        "FMA55700": "976cc169f13a7dbc04a174a762250ef5c8aa0e3f203393af06c409f04a801f9d",
        "FMA55703": "cbd80c0e2f15d6992bcdf4d5a7783c9ef283891feb63c11d31ec4ac26c218304",
        "FMA55704": "dba78fa4d615c628365e7263c5b95779e2bf3afe204d018e9730d02fda1e4630",
        "FMA55705": "999212e4a11bc79dbfdaa3e7e9d60fe0aeba5b2a27e6f92919d6c148bb1b607a",
        "FMA55706": "ddf516ec897b1eef09e667e3e3a5193726a4324e7d40e30167138076c216aee8",
        "FMA55798": "7dac15000d214518d672027f5f42371e330e888bd0fcecfa8543a2adc7e2e3c5",
        "FMA55799": "26ed6475fcf745c12a0fc503cd46d83b45501b0bfa88d90233dd35db3484bb6b",
        "FMA57140": "046af8c2d30cd439eb3766b35f4099f0f160ebc651192a68db7ccafcbb5e2bc4",
        "FMA57141": "b1ee66366dc7dcb03d909155824ff7e9fc98b89eadd09b4b99bea6f39e565af5",
        "FMA57142": "687ad3e8b9d3b7b40f23c241be1ea9660bd9808906c13e5223f78bd4c73bd898",
        "FMA57143": "7617248a11b170ad3940db35106e50ce43468a6db70c8c1b84d11b0a03963341",
    }
)
# Lines across a muscle, and points along each; a line's points lie a few millimetres apart.
LINES, POINTS = 9, 25
# Share of the width at either side that no line runs in: there the muscle is too thin to be met.
RIM = 0.06
# Share of a fan's length about its tip that lines end before: there they would all meet.
TIP = 0.04
# Area in the view, as a share of the largest triangle's, below which a triangle is seen edge on.
SIDEWAYS = 1e-12
# Places of a line that must lie on the muscle: fewer tell no direction.
LEAST_POINTS = 3


def fan_lines(
    surface: SurfaceData, tip: ArrayLike, normal: ArrayLike, *, lines: int = LINES
) -> tuple[Floats, ...]:
    """Lines from a broad origin that meet at a tip, such as those of temporalis at the coronoid.

    tip: (3,), mm, where the fibres meet.
    normal: (3,). Direction that the fan is looked at along.
    Returns: tuple of (n, 3), mm, from origin to tip, in the middle of the muscle.
    Raises `MeshError`: Less than two lines meet the muscle.
    """
    view = _View(surface, normal)
    centre = view.flat(np.asarray(tip, dtype=np.float64)[None])[0]
    offset = view.places - centre
    reach = np.linalg.norm(offset, axis=1)
    # Angles from the fan's own middle, so that no fan is cut by the turn at 180 degrees.
    middle = np.arctan2(*(offset[reach > 0.3 * reach.max()].sum(axis=0)[::-1]))
    far = reach > 0.2 * reach.max()
    angle = np.angle(np.exp(1j * (np.arctan2(offset[:, 1], offset[:, 0]) - middle)))[far]
    low, high = np.quantile(angle, (0.01, 0.99))
    rim = RIM * (high - low)
    found = []
    for turn in np.linspace(low + rim, high - rim, lines) + middle:
        ray = np.array([np.cos(turn), np.sin(turn)])
        steps = np.linspace(1.0, TIP, 2 * POINTS) * reach.max()
        found.append(view.lifted(centre + steps[:, None] * ray))
    return _kept(found)


def lane_lines(
    surface: SurfaceData, along: ArrayLike, normal: ArrayLike, *, lines: int = LINES
) -> tuple[Floats, ...]:
    """Parallel lines along a sheet, such as those of buccinator from behind to the mouth.

    along: (3,), from origin to insertion.
    normal: (3,). Direction that the sheet is looked at along.
    Returns: tuple of (n, 3), mm, from origin to insertion, in the middle of the muscle.
    Raises `MeshError`: Less than two lines meet the muscle.
    """
    view = _View(surface, normal)
    ahead = view.axes @ np.asarray(along, dtype=np.float64)
    ahead /= np.linalg.norm(ahead)
    across = np.array([-ahead[1], ahead[0]])
    place = view.places @ np.column_stack([ahead, across])
    low, high = place.min(axis=0), place.max(axis=0)
    rim = RIM * (high - low)[1]
    steps = np.linspace(low[0], high[0], 2 * POINTS)
    rows = np.linspace(low[1] + rim, high[1] - rim, lines)
    return _kept([view.lifted(steps[:, None] * ahead + row * across) for row in rows])


class _View:
    """A surface looked at along an axis: places in the plane, and the middle of it in depth."""

    def __init__(self, surface: SurfaceData, normal: ArrayLike) -> None:
        axis = np.asarray(normal, dtype=np.float64)
        axis = axis / np.linalg.norm(axis)
        helper = np.eye(3)[np.argmin(np.abs(axis))]
        first = np.cross(axis, helper)
        first /= np.linalg.norm(first)
        self.axes = np.array([first, np.cross(axis, first)])
        self._axis = axis
        vertices = surface.vertices
        self.places = self.flat(vertices)
        self._depths = vertices @ axis
        self._triangles = surface.triangles

    def flat(self, points: Floats) -> Floats:
        """Where points lie in the plane, (n, 2)."""
        flat: Floats = points @ self.axes.T
        return flat

    def lifted(self, places: Floats) -> Floats:
        """The middle of the muscle over the longest run of places that lie on it, (n, 3)."""
        corners = self.places[self._triangles]
        depths = self._depths[self._triangles]
        edge, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0]
        # Triangles seen from the side cover nothing.
        seen = np.abs(area) > SIDEWAYS * np.abs(area).max()
        corners, depths, area = corners[seen], depths[seen], area[seen]
        edge, other = edge[seen], other[seen]
        runs: list[list[Floats]] = [[]]
        for place in places:
            offset = place - corners[:, 0]
            v = (offset[:, 0] * other[:, 1] - offset[:, 1] * other[:, 0]) / area
            w = (edge[:, 0] * offset[:, 1] - edge[:, 1] * offset[:, 0]) / area
            over: NDArray[np.bool_] = (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0)
            if np.count_nonzero(over) < 2:
                runs.append([])
                continue
            met = depths[over]
            rise, other_rise = met[:, 1] - met[:, 0], met[:, 2] - met[:, 0]
            depth = met[:, 0] + v[over] * rise + w[over] * other_rise
            # The layer that is met first and last: of a sheet, its two faces.
            middle = 0.5 * (depth.min() + depth.max())
            runs[-1].append(place @ self.axes + middle * self._axis)
        return np.array(max(runs, key=len)).reshape(-1, 3)


def _kept(found: list[Floats]) -> tuple[Floats, ...]:
    lines = tuple(line for line in found if len(line) >= LEAST_POINTS)
    if len(lines) < 2:
        raise MeshInputError(
            f"{len(lines)} fibre lines meet two faces of the muscle: two are needed; check that "
            "it is closed, and that the normal is that of the sheet"
        )
    return lines
